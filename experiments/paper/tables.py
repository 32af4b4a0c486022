"""What the paper's tables share: rows, each a way to train, and columns, the demonstrations of a new task."""

import statistics
from typing import Any, NamedTuple

import cells
import options
from absl import flags

import milx
from milx.config import assemble
from milx.config.schema import Config
from milx.evaluation.results import intervals

flags.adopt_module_key_flags(options)
_ROWS = flags.DEFINE_list("rows", None, "Which rows; default all.")


class Row(NamedTuple):
    """A way to train.

    Attributes:
        label: what the table calls it.
        method: the method.
        changes: what is changed of its preset, by dotted name.
        paper: what the paper reports.
    """

    label: str
    method: str
    changes: dict[str, Any]
    paper: str = ""


class Table(NamedTuple):
    """A table of the paper.

    Attributes:
        folder: of its cells, in results/.
        env: the environment.
        rows: by name.
        shots: a column for each.
    """

    folder: str
    env: str
    rows: dict[str, Row]
    shots: tuple[int, ...]


def configure(env: str, row: Row, shots: int, seed: int) -> Config:
    """Configures a cell: trained on single demonstrations, with another appearance whenever they are drawn."""
    config = cells.configure(env, row.method, options.PRESET.value, seed, options.STEPS.value)
    config.train.redraw = True
    config.evaluation.shots = shots
    for name, value in row.changes.items():
        assemble.assign(config, name, value)
    return config


def chosen(table: dict[str, Any]) -> dict[str, Any]:
    """Selects those of a table's rows that were chosen, by name.

    Raises:
        ValueError: for a row that the table does not have; the message lists those that it has.
    """
    if unknown := sorted(set(_ROWS.value or ()) - set(table)):
        raise ValueError(f"rows: got {unknown[0]!r}, expected some of {', '.join(table)}")
    return {name: row for name, row in table.items() if _ROWS.value is None or name in _ROWS.value}


def make(table: Table) -> None:
    """Runs what is missing, unless told only to show what there is, and prints a table for every criterion.

    Raises:
        ValueError: for a row that the table does not have; the message lists those that it has.
    """
    milx.configure()
    rows = chosen(table.rows)
    folder = options.folder(table.folder)
    runners: dict[int, cells.Cells] = {}
    seeds = range(options.SEEDS.value)
    for seed in seeds:
        for name, row in {} if options.SHOW.value else rows.items():
            of_shots = {f"{name}-{shots}-{seed}": configure(table.env, row, shots, seed) for shots in table.shots}
            tasks = configure(table.env, row, 1, seed).data.tasks
            runners.setdefault(tasks, cells.Cells(folder, tasks)).run(of_shots)
    print(markdown(table, list(rows), cells.read(folder)))


def markdown(table: Table, rows: list[str], found: dict[str, dict[str, Any]]) -> str:
    """Writes a table for every criterion: means of the seeds, their intervals, baselines and upper bound.

    Args:
        table: the table.
        rows: the names of those to show; such as have no result are left out.
        found: all results, by the names of their cells.
    """
    runs = {name: [_of_seeds(found, f"{name}-{shots}") for shots in table.shots] for name in rows}
    runs = {name: columns for name, columns in runs.items() if all(columns)}
    if not runs:
        return "No results yet."
    longest = max(runs.values(), key=lambda columns: len(columns[0]))
    first, lines = longest[0][0], []
    head = [f"{k}-shot" for k in table.shots] + ["paper"]
    for criterion in (first["criterion"], *first.get("other_criteria", ())):
        lines += [f"| {criterion} | {' | '.join(head)} |", "|---|" + "---|" * len(head)]
        for name, columns in runs.items():
            shown = [interval([judged(run, criterion) for run in seeds]) for seeds in columns]
            lines.append(f"| {table.rows[name].label} | {' | '.join(shown)} | {table.rows[name].paper} |")
        baselines = [[judged(run, criterion)["baselines"] for run in seeds] for seeds in longest]
        for name in ("random", "task_blind", "expert"):
            shown = [f"{statistics.mean(run[name] for run in seeds):.1%}" for seeds in baselines]
            lines.append(f"| *{name.replace('_', '-')}* | {' | '.join(shown)} | |")
        lines.append("")
    return "\n".join([*lines, f"{first['trials']} trials for each seed; in brackets their intervals and their number."])


def _of_seeds(found: dict[str, dict[str, Any]], name: str) -> list[dict[str, Any]]:
    return [found[cell] for seed in range(options.SEEDS.value) if (cell := f"{name}-{seed}") in found]


def judged(run: dict[str, Any], criterion: str) -> dict[str, Any]:
    """Selects success, interval and baselines of a result file by one of its criteria."""
    return run if criterion == run["criterion"] else run["other_criteria"][criterion]


def interval(runs: list[dict[str, Any]]) -> str:
    """Writes the mean over runs, from where to where their 95% intervals reach, and how many there are."""
    ends = intervals(runs)
    low, high = min(end[0] for end in ends), max(end[1] for end in ends)
    return f"{statistics.mean(run['success'] for run in runs):.1%} ({low:.1%} to {high:.1%}; {len(runs)})"
