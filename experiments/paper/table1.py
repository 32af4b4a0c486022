"""Table 1 of the paper: push, by what the demonstrations show and how many of them there are.

    python experiments/paper/table1.py                # what is missing, then the table; --show runs nothing
    python experiments/paper/table1.py --rows=mil-video

One row has four times the tasks. Stopped and started again it goes on with its last checkpoint.
"""

from typing import Any

import cells
import tables
from absl import app, flags
from tables import Row, Table

from milx.config.schema import GIVEN

flags.adopt_module_key_flags(tables)

PAPER = {
    "lstm-video-state-action": "78.4 / 83.1%",
    "lstm-video-state": "37.6 / 39.6%",
    "lstm-video": "34.2 / 32.0%",
    "contextual-video-state": "58.1 / 64.6%",
    "contextual-video": "57.0 / 59.0%",
    "mil-video-state-action": "85.8 / 88.8%",
    "mil-video-state": "72.5 / 78.2%",
    "mil-video": "66.4 / 70.5%",
}
LABELS = {"mil": "MIL + goal head", "lstm": "LSTM + goal head", "contextual": "contextual + goal head"}
"""What is called MIL alone is the method as published (`published.py`)."""
TEMPORAL = {
    "network.learned_loss": "temporal",
    "train.support_frames": None,
    "train.meta_batch": 8,
    "train.steps": 15_000,
}
"""The loss that convolves over time sees all frames, so it trains with a quarter of the tasks and half the updates."""
HINDSIGHT = {"method.given": "video", "network.learned_loss": "linear", "network.hindsight_head": True}
"""Beyond the paper: where the robot went is read off the video."""


def _rows() -> dict[str, Row]:
    rows: dict[str, Row] = {}

    def add(name: str, label: str, method: str, changes: dict[str, Any]) -> None:
        rows[name] = Row(label, method, changes, PAPER.get(name, ""))

    for given in GIVEN:
        name, shown = given.replace("+", "-"), given.replace("+", " + ")
        for method in cells.METHODS["push"]:
            learned = {"network.learned_loss": "linear"} if method == "mil" and given != GIVEN[0] else {}
            add(f"{method}-{name}", f"{LABELS[method]}, {shown}", method, {"method.given": given} | learned)
        if given != GIVEN[0]:
            add(
                f"mil-temporal-{name}",
                f"{LABELS['mil']}, temporal loss, {shown}",
                "mil",
                {"method.given": given, **TEMPORAL},
            )
    add("mil-hindsight-video", "MIL + goal and hindsight heads, video", "mil", HINDSIGHT)
    add(
        "mil-four-times",
        "MIL + goal head, video + state + action, four times as many tasks",
        "mil",
        {"data.tasks": 3076},
    )
    return rows


TABLE = Table("table1", "push", _rows(), shots=(1, 5))

if __name__ == "__main__":
    app.run(lambda _: tables.make(TABLE))
