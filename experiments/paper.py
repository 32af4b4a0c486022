"""The method as published: its results, why it learns, and what milx's additions are worth on top of it.

    python experiments/paper.py --table=results     # what is missing, then the table; --show runs nothing
    python experiments/paper.py --table=plateau --rows=released,fast-expert

Stopped and started again it goes on with its last checkpoint.
"""

import statistics
from typing import Any, NamedTuple

import cells
import options
from absl import app, flags
from tables import interval

from milx import config as config_lib
from milx.config import Config
from milx.presets import make_config

flags.adopt_module_key_flags(options)


class Row(NamedTuple):
    """A way to train.

    Attributes:
        label: what the table calls it.
        env: the environment.
        changes: what is changed of the preset `paper`, by dotted name.
        published: what the paper reports.
        shots: demonstrations at test, a result for each.
        method: the method.
    """

    label: str
    env: str
    changes: dict[str, Any]
    published: str = ""
    shots: tuple[int, ...] = (1,)
    method: str = "mil"


RELEASED = {
    "mil.whiten_actions": False,
    "mil.loss_scale": 100.0,
    "mil.inner_lr": 1e-3,
    "network.fc_init_std": 0.01,
    "optimizer.warmup": 0.0,
    "optimizer.cosine": False,
    "optimizer.clip_norm": None,
    "train.imitation_steps": 0,
}
"""What turns reach's `paper` back into the numbers of the released code."""
RAW = {name: value for name, value in RELEASED.items() if name.startswith("mil.")}
FAST_EXPERT = {"env.action_cost": 1.0}
SHORT = {"train.steps": 5000, "train.eval_every": 1000}
CORES = {
    "env.image_shape": (32, 40),
    "data.tasks": 600,
    "data.demos_per_task": 4,
    "train.meta_batch": 16,
    "train.support_frames": 10,
    "train.query_frames": 10,
    "train.steps": 12_000,
}
"""What two cores manage in an hour."""
VIDEO_STATE = {"mil.given": "video+state", "network.learned_loss": "linear", "network.heads": 2}
VIDEO = {**VIDEO_STATE, "mil.given": "video", "network.inner_first_layer": True}


def without(changes: dict[str, Any], *groups: str) -> dict[str, Any]:
    """The changes but for the fields whose names begin so."""
    return {name: value for name, value in changes.items() if not name.startswith(groups)}


TABLES = {
    "results": {
        "reach": Row("reach, vision", "reach", {}, "a curve"),
        "reach-state": Row("reach, states", "reach_state", {}, "a curve"),
        "push": Row("push", "push", {"network.heads": 1}, "80.6 / 82.6%", (1, 5)),
        "push-two-heads": Row("push, two heads", "push", {}, "85.8 / 88.8%", (1, 5)),
        "push-video-state": Row("push, video + state", "push", VIDEO_STATE, "72.5 / 78.2%", (1, 5)),
        "push-video": Row("push, video", "push", VIDEO, "66.4 / 70.5%", (1, 5)),
    },
    "plateau": {
        "released": Row("the released numbers", "reach", RELEASED | SHORT),
        "whitened": Row("+ whitened actions", "reach", without(RELEASED, "mil.") | SHORT),
        "lecun": Row("+ LeCun's start", "reach", without(RELEASED, "mil.", "network.") | SHORT),
        "schedule": Row("+ clip, warm-up, cosine", "reach", {"train.imitation_steps": 0} | SHORT),
        "imitation": Row("+ imitation first: `paper`", "reach", SHORT),
        "raw": Row("`paper` without whitened actions", "reach", RAW | SHORT),
        "small-start": Row("`paper`, weights from N(0, 0.01)", "reach", {"network.fc_init_std": 0.01} | SHORT),
        "five-tasks": Row("`paper`, five tasks in a meta-batch", "reach", {"train.meta_batch": 5} | SHORT),
        "three-frames": Row(
            "`paper`, 3 time steps of 64 tasks",
            "reach",
            {"train.support_frames": 3, "train.query_frames": 3, "train.meta_batch": 64} | SHORT,
        ),
        "fast-expert": Row("`paper`, an expert that moves at once", "reach", FAST_EXPERT | SHORT),
        "fast-schedule": Row("the same without imitation", "reach", FAST_EXPERT | {"train.imitation_steps": 0} | SHORT),
        "fast-lecun": Row(
            "the same without clip, warm-up, cosine",
            "reach",
            FAST_EXPERT | without(RELEASED, "mil.", "network.") | SHORT,
        ),
        "fast-whitened": Row("the same from N(0, 0.01)", "reach", FAST_EXPERT | without(RELEASED, "mil.") | SHORT),
        "fast-released": Row("the released numbers, that expert", "reach", FAST_EXPERT | RELEASED | SHORT),
    },
    "cores": {
        "cores": Row("32x40 pixels", "reach", CORES),
        "cores-24-tasks": Row(
            "24 tasks, 6 time steps",
            "reach",
            CORES | {"train.meta_batch": 24, "train.support_frames": 6, "train.query_frames": 6},
        ),
        "cores-rate": Row("2e-3", "reach", CORES | {"optimizer.learning_rate": 2e-3}),
        "cores-alpha": Row("0.1", "reach", CORES | {"mil.inner_lr": 0.1}),
    },
}
_TABLE = flags.DEFINE_enum("table", "results", list(TABLES), "Which table.")
_SEED = flags.DEFINE_integer("first_seed", 0, "The first of the seeds.")


def configure(row: Row, shots: int, seed: int) -> Config:
    """A cell of a table."""
    config = make_config(row.env, row.method, "paper", seed)
    config.evaluation.shots = shots
    for name, value in row.changes.items():
        config_lib.assign(config, name, value)
    if options.STEPS.value:
        config.train.steps = options.STEPS.value
    return config


def main(_: list[str]) -> None:
    """Runs what is missing and prints a table."""
    rows, folder = options.rows(TABLES[_TABLE.value]), options.folder(f"paper_{_TABLE.value}")
    runners: dict[str, cells.Cells] = {}
    for seed in range(_SEED.value, _SEED.value + options.SEEDS.value):
        for name in () if options.SHOW.value else rows:
            named = {f"{name}-{k}-{seed}": configure(rows[name], k, seed) for k in rows[name].shots}
            tasks = configure(rows[name], 1, seed).data.tasks
            runners.setdefault(rows[name].env, cells.Cells(folder, tasks)).run(named)
    print(markdown(rows, cells.read(folder)))


def markdown(rows: dict[str, Row], found: dict[str, dict[str, Any]]) -> str:
    """A table of what there is: the mean of the seeds, their intervals, the paper's number and the floors."""
    lines = ["| | success | another task's demonstration | random | task-blind | expert | training | paper |"]
    lines.append("|---|---|---|---|---|---|---|---|")
    for name, row in rows.items():
        columns = [[run for cell, run in found.items() if cell.rpartition("-")[0] == f"{name}-{k}"] for k in row.shots]
        if not all(columns):
            continue
        shown = " / ".join(interval(runs) for runs in columns)
        floors = [
            f"{statistics.mean(run['baselines'][floor] for run in columns[0]):.1%}"
            for floor in ("other_demo", "random", "task_blind", "expert")
        ]
        minutes = f"{statistics.mean(run['wall_clock_s']['train'] for run in columns[0]):.0f} s"
        lines.append(f"| {row.label} | {shown} | {' | '.join(floors)} | {minutes} | {row.published} |")
    return "\n".join(lines)


if __name__ == "__main__":
    app.run(main)
