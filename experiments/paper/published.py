"""The method as published: its results, why it learns, and what milx's additions are worth on top of it.

    python experiments/paper/published.py --table=results     # what is missing, then the table; --show runs nothing
    python experiments/paper/published.py --table=plateau --rows=released,whitened --seeds=1
    python experiments/paper/published.py --table=plateau --show --rows=released,whitened --curves=FILE    # a figure

The other tables are `small` (32x40 pixels), `baselines`, `ladder`, `relatives`, `experts` and `grasp`;
`published_rows.py` says what each of their rows changes. Stopped and started again it goes on with its last checkpoint.
"""

import pathlib
import statistics
from typing import Any

import cells
import matplotlib.pyplot as plt
import options
from absl import app, flags
from published_rows import TABLES, Row, configure
from tables import chosen, interval

import milx

RESULTS = pathlib.Path(__file__).parents[1] / "results" / "paper_results"
"""The folder of the table `results`."""

for _name in ("seeds", "show", "out", "rows"):  # the others of options.py do nothing here
    flags.declare_key_flag(_name)
_TABLE = flags.DEFINE_enum("table", "results", list(TABLES), "Which table.")
_SEED = flags.DEFINE_integer("first_seed", 0, "The first of the seeds.")
_CURVES = flags.DEFINE_string("curves", None, "Where to draw the learning curves; default nowhere.")


def main(_: list[str]) -> None:
    """Runs what is missing and prints a table."""
    milx.configure()
    rows, folder = chosen(TABLES[_TABLE.value]), options.folder(f"paper_{_TABLE.value}")
    trained = {} if options.SHOW.value else own(_TABLE.value, rows)
    runners: dict[str, cells.Cells] = {}
    for seed in range(_SEED.value, _SEED.value + options.SEEDS.value):
        for name, row in trained.items():
            named = {f"{name}-{shots}-{seed}": configure(row, shots, seed) for shots in row.shots}
            tasks = configure(row, 1, seed).data.tasks
            runners.setdefault(row.env, cells.Cells(folder, tasks)).run(named)
    shared = {} if _TABLE.value == "results" else cells.read(RESULTS)
    found = shared | cells.read(folder)
    print(markdown(rows, found))
    if _CURVES.value:
        draw(rows, found, _CURVES.value)


def own(table: str, rows: dict[str, Row]) -> dict[str, Row]:
    """Selects those of a table's rows that are trained for it: other tables show some of the results again."""
    return {name: row for name, row in rows.items() if table == "results" or name not in TABLES["results"]}


def _runs(name: str, shots: int, found: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """Selects the result files of a row's seeds."""
    return [run for cell, run in found.items() if cell.rpartition("-")[0] == f"{name}-{shots}"]


def markdown(rows: dict[str, Row], found: dict[str, dict[str, Any]]) -> str:
    """Writes a table of what there is: the mean of the seeds, their intervals, the paper's number and the baselines.

    Without a column for the paper's number where no row has one.
    """
    head = ["", "success", "with another task's", "random", "task-blind", "expert", "training", "paper"]
    shown = len(head) if any(row.published for row in rows.values()) else len(head) - 1
    lines = [head, ["---"] * len(head)]
    for name, row in rows.items():
        columns = [_runs(name, shots, found) for shots in row.shots]
        if not all(columns):
            continue
        success = " / ".join(interval(runs) for runs in columns)
        baselines = [
            f"{statistics.mean(run['baselines'][baseline] for run in columns[0]):.1%}"
            if baseline in columns[0][0]["baselines"]
            else ""  # not measured yet when it ran
            for baseline in ("other_demo", "random", "task_blind", "expert")
        ]
        seconds = f"{statistics.mean(run['wall_clock_s']['train'] for run in columns[0]):.0f} s"
        lines.append([row.label, success, *baselines, seconds, row.published])
    return "\n".join(f"| {' | '.join(line[:shown])} |" for line in lines)


def draw(rows: dict[str, Row], found: dict[str, dict[str, Any]], path: str) -> None:
    """Draws validation success, and by how much another task's demonstration is worse, against the meta-updates."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4), layout="constrained")
    colors = [plt.get_cmap(name)(i) for name, count in (("tab10", 10), ("Set2", 8)) for i in range(count)]
    for number, (name, row) in enumerate(rows.items()):
        with_curve = [run for run in _runs(name, row.shots[0], found) if "curve" in run]
        for i, run in enumerate(with_curve):
            label = None if i else row.label.replace("`", "")
            style = {"color": colors[number % len(colors)], "lw": 1.2, "label": label}
            steps = [line["step"] for line in run["curve"]]
            left.plot(steps, [100 * line["validation_success"] for line in run["curve"]], **style)
            right.plot(steps, [line["other_demo"] / line["own_demo"] for line in run["curve"]], **style)
    left.set(xlabel="meta-updates", ylabel="success on validation tasks (%)", ylim=(0, 100))
    right.set(xlabel="meta-updates", ylabel="error: another task's demonstration / its own")
    right.axhline(1.0, color="0.6", lw=0.8)
    left.legend(fontsize=7)
    figure.savefig(path, dpi=150)
    plt.close(figure)


if __name__ == "__main__":
    app.run(main)
