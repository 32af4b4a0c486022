"""Writes the benchmarks in experiments/results/benchmarks/ as Markdown tables, and draws what is compared.

    python experiments/benchmarks/summary.py docs/benchmarks.png

A row is named "question: who", or "who" where a file asks one question only. Whoever begins with "milx" is milx, and
all others with the same question and unit are its peers.
"""

import itertools
import json
import pathlib
import sys
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
from matplotlib.ticker import MaxNLocator

FOLDER = pathlib.Path(__file__).parents[1] / "results" / "benchmarks"
Row = dict[str, Any]


class Question(NamedTuple):
    """Rows that answer one question.

    Attributes:
        title: the benchmark and the question.
        unit: of all rows.
        hardware: on which they were measured.
        rows: as in the file, without what was not run.
    """

    title: str
    unit: str
    hardware: str
    rows: list[Row]

    def rival(self, row: Row) -> Row | None:
        """Returns the row of milx with which a peer is compared; None for a row of milx, and where milx has none.

        It is the best one of those that end like the peer's name (", bfloat16"), or of all if there is none.
        """
        ours = [other for other in self.rows if _who(other).startswith("milx")]
        if row in ours or not ours:
            return None
        end = _who(row).rpartition(", ")[2]
        alike = [other for other in ours if _who(other).endswith(f", {end}")]
        return (max if is_rate(self.unit) else min)(alike or ours, key=lambda other: other["median"])


def is_rate(unit: str) -> bool:
    """Tells whether more of this unit is better."""
    return unit.endswith("/s")


def _who(row: Row) -> str:
    return row["name"].rpartition(": ")[2]


def questions(result: dict[str, Any]) -> list[Question]:
    """Groups the rows of a file."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in result["rows"]:
        if row["median"] is not None:
            groups.setdefault((row["name"].rpartition(": ")[0], row["unit"]), []).append(row)
    return [
        Question(", ".join(filter(None, (_title(result), question))), unit, result["hardware"], rows)
        for (question, unit), rows in groups.items()
    ]


def factor(ours: float, theirs: float, unit: str) -> float:
    """Computes by which factor milx is faster, or its cost lower, than a peer."""
    return ours / theirs if is_rate(unit) else theirs / ours


def _ratio(question: Question, row: Row) -> str:
    """Formats that factor of the medians, and its lowest and highest value in a run in which both were measured."""
    ours = question.rival(row)
    if ours is None:
        return ""
    both = zip(ours.get("runs", ()), row.get("runs", ()), strict=True)
    runs = [factor(*pair, question.unit) for pair in both if None not in pair]
    spread = f" ({_short(min(runs))} to {_short(max(runs))})" if len(runs) > 1 else ""
    return f"{_short(factor(ours['median'], row['median'], question.unit))}{spread}"


def number(row: Row) -> str:
    """Formats the median of a row and the spread of its runs, or says that it was not run."""
    if row["median"] is None:
        return f"not run ({row['note']})"
    runs = [run for run in row.get("runs", ()) if run is not None]
    spread = f" ({_short(min(runs))} to {_short(max(runs))})" if len(runs) > 1 else ""
    return f"{_short(row['median'])} {row['unit']}".strip() + spread


def _short(value: float) -> str:
    """Formats a number with three digits, or more before the point."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def table(results: list[dict[str, Any]]) -> str:
    """Formats all rows of all files."""
    lines = ["| benchmark | what | median (runs) | milx is better by | memory |", "|---|---|---|---|---|"]
    for result in results:
        ratios = {row["name"]: _ratio(question, row) for question in questions(result) for row in question.rows}
        for row in result["rows"]:
            memory = "" if row["peak_memory_gib"] is None else f"{row['peak_memory_gib']:.2f} GiB"
            cells = [_title(result), row["name"], number(row), ratios.get(row["name"], ""), memory]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def origins(results: list[dict[str, Any]]) -> str:
    """Formats when, on what and with which versions the files were measured."""
    lines = ["| benchmark | date | runs | on | commit | versions |", "|---|---|---|---|---|---|"]
    for result in results:
        installed = {name: version for name, version in result["versions"].items() if version != "not installed"}
        versions = ", ".join(f"{name} {version}" for name, version in installed.items() if name != "milx")
        runs = max(len(row.get("runs", [0])) for row in result["rows"])
        date = result.get("date", "before November 27, 2026")
        cells = [_title(result), date, str(runs), result["hardware"], result["commit"][:7], versions]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _title(result: dict[str, Any]) -> str:
    """Names a file: those without an accelerator end in "-cpu"."""
    return result["benchmark"] + ("" if "NVIDIA" in result["hardware"] else "-cpu")


def draw(results: list[dict[str, Any]], path: pathlib.Path) -> None:
    """Draws a panel for each question in which milx has a peer, as bars from zero; peers are gray."""
    asked = itertools.chain.from_iterable(map(questions, results))
    drawn = [question for question in asked if any(map(question.rival, question.rows))]
    pairs = itertools.zip_longest(drawn[::2], drawn[1::2])
    heights = [0.7 + 0.16 * max(len(question.rows) for question in pair if question) for pair in pairs]
    figure, axes = plt.subplots(
        len(heights), 2, figsize=(11, sum(heights)), height_ratios=heights, squeeze=False, layout="constrained"
    )
    if len(drawn) % 2:
        axes[-1, -1].set_axis_off()
    for axis, question in zip(axes.ravel(), drawn, strict=False):
        medians = [row["median"] for row in question.rows]
        ours = [_who(row).startswith("milx") for row in question.rows]
        bars = axis.barh(
            [_who(row) for row in question.rows], medians, color=["tab:blue" if mine else "0.7" for mine in ours]
        )
        axis.bar_label(bars, [f" {_short(x)}" for x in medians], fontsize=6)
        better = "more" if is_rate(question.unit) else "less"
        axis.set_title(
            f"{question.title}\n{question.unit or 'cost'}, {better} is better, {question.hardware}", fontsize=7
        )
        axis.margins(x=0.25)
        axis.xaxis.set_major_locator(MaxNLocator(5))
        axis.xaxis.set_major_formatter("{x:,.10g}")
        axis.invert_yaxis()
        axis.tick_params(labelsize=6)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(path: str) -> None:
    """Prints the tables, and writes the chart."""
    results = [json.loads(file.read_text()) for file in sorted(FOLDER.glob("*.json"))]
    print(table(results), origins(results), sep="\n\n")
    draw(results, pathlib.Path(path))


if __name__ == "__main__":
    main(sys.argv[1])
