"""What tables 1 and 2 share: rows of push, each a way to train, evaluated with one demonstration and with five."""

import statistics
from typing import Any, NamedTuple

import cells
import options
from absl import flags

from milx import config as config_lib
from milx.config import Config

SHOTS = (1, 5)

flags.adopt_module_key_flags(options)
_ROWS = flags.DEFINE_list("rows", None, "Which rows; default all.")


class Row(NamedTuple):
    """A method, and what is changed of its preset, by dotted name."""

    method: str
    changes: dict[str, Any]


def configure(row: Row, shots: int, seed: int) -> Config:
    """A cell: trained on single demonstrations, in new looks whenever they are drawn."""
    config = cells.configure("push", row.method, options.PRESET.value, seed, options.STEPS.value)
    config.train.redraw = True
    config.evaluation.shots = shots
    config.evaluation.batch = max(config.evaluation.batch // shots, 1)
    for name, value in row.changes.items():
        config_lib.assign(config, name, value)
    return config


def make(table: str, rows: dict[str, Row]) -> None:
    """Runs what is missing and prints the table: means of the seeds, by the paper's and by the other criterion.

    Raises:
        ValueError: for a row that the table does not have; the message lists those that it has.
    """
    if unknown := sorted(set(_ROWS.value or ()) - set(rows)):
        raise ValueError(f"rows: got {unknown[0]!r}, expected some of {', '.join(rows)}")
    rows = {name: row for name, row in rows.items() if _ROWS.value is None or name in _ROWS.value}
    folder = options.folder(table)
    runner = cells.Cells(folder, configure(next(iter(rows.values())), 1, seed=0).data.tasks)
    for seed in range(options.SEEDS.value):
        for name, row in rows.items():
            for shots in SHOTS:
                runner.run(f"{name}-{shots}-{seed}", configure(row, shots, seed))
    results = cells.read(folder)
    print("| | " + " | ".join(f"{shots}-shot" for shots in SHOTS) + " |\n|---|" + "---|" * len(SHOTS))
    for name in rows:
        shown = []
        for shots in SHOTS:
            runs = [results[f"{name}-{shots}-{seed}"] for seed in range(options.SEEDS.value)]
            success = statistics.mean(run["success"] for run in runs)
            others = (next(iter(run["other_criteria"].values())) for run in runs)
            shown.append(f"{success:.1%} ({statistics.mean(other['success'] for other in others):.1%})")
        print(f"| {name} | {' | '.join(shown)} |")
