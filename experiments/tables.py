"""What the paper's tables share: rows, each a way to train, and columns, the demonstrations of a new task."""

import statistics
from typing import Any, NamedTuple

import cells
import options
from absl import flags

from milx import config as config_lib
from milx.config import Config

flags.adopt_module_key_flags(options)
_ROWS = flags.DEFINE_list("rows", None, "Which rows; default all.")


class Row(NamedTuple):
    """A method, and what is changed of its preset, by dotted name."""

    method: str
    changes: dict[str, Any]


class Table(NamedTuple):
    """A table of the paper.

    Attributes:
        name: of its folder in results/.
        env: the environment.
        rows: by name.
        shots: a column for each.
    """

    name: str
    env: str
    rows: dict[str, Row]
    shots: tuple[int, ...]


def configure(env: str, row: Row, shots: int, seed: int) -> Config:
    """A cell: trained on single demonstrations, in new looks whenever they are drawn."""
    config = cells.configure(env, row.method, options.PRESET.value, seed, options.STEPS.value)
    config.train.redraw = True
    config.evaluation.shots = shots
    config.evaluation.batch = max(config.evaluation.batch // shots, 1)
    for name, value in row.changes.items():
        config_lib.assign(config, name, value)
    return config


def make(table: Table) -> None:
    """Runs what is missing and prints the table: means of the seeds, and in brackets by other criteria.

    Raises:
        ValueError: for a row that the table does not have; the message lists those that it has.
    """
    if unknown := sorted(set(_ROWS.value or ()) - set(table.rows)):
        raise ValueError(f"rows: got {unknown[0]!r}, expected some of {', '.join(table.rows)}")
    rows = {name: row for name, row in table.rows.items() if _ROWS.value is None or name in _ROWS.value}
    folder, runners = options.folder(table.name), {}
    for seed in range(options.SEEDS.value):
        for name, row in rows.items():
            for shots in table.shots:
                config = configure(table.env, row, shots, seed)
                runner = runners.setdefault(config.data.tasks, cells.Cells(folder, config.data.tasks))
                runner.run(f"{name}-{shots}-{seed}", config)
    results = cells.read(folder)
    print("| | " + " | ".join(f"{shots}-shot" for shots in table.shots) + " |\n|---|" + "---|" * len(table.shots))
    for name in rows:
        shown = []
        for shots in table.shots:
            runs = [results[f"{name}-{shots}-{seed}"] for seed in range(options.SEEDS.value)]
            others = [
                statistics.mean(run["other_criteria"][criterion]["success"] for run in runs)
                for criterion in runs[0].get("other_criteria", ())
            ]
            brackets = f" ({', '.join(f'{other:.1%}' for other in others)})" if others else ""
            shown.append(f"{statistics.mean(run['success'] for run in runs):.1%}{brackets}")
        print(f"| {name} | {' | '.join(shown)} |")
