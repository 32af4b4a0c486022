"""Prints the benchmarks in experiments/results/benchmarks/ as one Markdown table, and draws them.

python experiments/benchmarks/summary.py docs/benchmarks.png
"""

import json
import pathlib
import sys

import matplotlib.pyplot as plt
from matplotlib.ticker import NullFormatter

PEERS = ("PyTorch", "JAX, vmap", "MJX", "mujoco", "mapped jvp", "hydrax", "jaxopt", "higher", "TorchOpt", "learn2learn")
FOLDER = pathlib.Path(__file__).parents[1] / "results" / "benchmarks"


def number(row: dict) -> str:
    """Formats the median of a row, or says that there is none."""
    return f"not run ({row['note']})" if row["median"] is None else f"{row['median']:,.4g} {row['unit']}".strip()


def table(results: list[dict]) -> str:
    """Formats all rows of all files."""
    lines = ["| benchmark | what | median | memory | on | commit |", "|---|---|---|---|---|---|"]
    for result in results:
        for row in result["rows"]:
            memory = "" if row["peak_memory_gib"] is None else f"{row['peak_memory_gib']:.2f} GiB"
            cells = [result["benchmark"], row["name"], number(row), memory, result["hardware"], result["commit"][:7]]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def panels(results: list[dict]) -> list[tuple[str, list[dict]]]:
    """Selects the rows of every panel, with its title: those of one file and one unit, without what was not run."""
    found = []
    for result in results:
        rows = [row for row in result["rows"] if row["median"] is not None and not row["unit"].startswith("%")]
        for unit in dict.fromkeys(row["unit"] for row in rows):
            title = ", ".join(filter(None, (result["benchmark"], unit, result["hardware"])))
            found.append((title, [row for row in rows if row["unit"] == unit]))
    return found


def draw(results: list[dict], path: pathlib.Path) -> None:
    """Draws the panels as bars, one below the other, each as high as it has rows; peers are gray."""
    drawn = panels(results)
    heights = [0.5 + 0.16 * len(rows) for _, rows in drawn]
    figure, axes = plt.subplots(
        len(drawn), 1, figsize=(9, sum(heights)), height_ratios=heights, squeeze=False, layout="constrained"
    )
    for axis, (title, rows) in zip(axes[:, 0], drawn, strict=True):
        medians = [row["median"] for row in rows]
        peers = [any(peer in row["name"] for peer in PEERS) for row in rows]
        labels = [row["name"] for row in rows]
        bars = axis.barh(labels, medians, color=["0.7" if peer else "tab:blue" for peer in peers])
        axis.bar_label(
            bars, [f" {median:,.0f}" if median >= 100 else f" {median:.3g}" for median in medians], fontsize=6
        )
        axis.set(xscale="log", xlim=(min(medians) / 3, max(medians) * 3))
        axis.set_title(title, fontsize=8)
        axis.invert_yaxis()
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.tick_params(labelsize=6)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(path: str) -> None:
    """Prints the table, writes the plot."""
    results = [json.loads(file.read_text()) for file in sorted(FOLDER.glob("*.json"))]
    print(table(results))
    draw(results, pathlib.Path(path))


if __name__ == "__main__":
    main(sys.argv[1])
