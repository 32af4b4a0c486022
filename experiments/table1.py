"""Table 1 of the paper: push, by what the demonstrations show and how many of them there are.

    python experiments/table1.py                # what is missing, then the table; --show runs nothing
    python experiments/table1.py --rows=mil-video

Stopped and started again it goes on with the next cell.
"""

import cells
import tables
from absl import app, flags
from tables import Row, Table

from milx.config import GIVEN

flags.adopt_module_key_flags(tables)

TEMPORAL = {"network.learned_loss": "temporal", "train.support_frames": None, "train.meta_batch": 16}
"""The loss that convolves over time sees all frames, of fewer tasks."""
ROBOT_HEAD = {"mil.given": "video", "network.learned_loss": "linear", "network.robot_head": True}
"""Beyond the paper: what of the state a video shows is read off it."""


def _rows() -> dict[str, Row]:
    rows = {}
    for given in GIVEN:
        name = given.replace("+", "-")
        for method in cells.METHODS["push"]:
            learned = "linear" if method == "mil" and given != GIVEN[0] else None
            rows[f"{method}-{name}"] = Row(method, {"mil.given": given, "network.learned_loss": learned})
        if given != GIVEN[0]:
            rows[f"mil-temporal-{name}"] = Row("mil", {"mil.given": given, **TEMPORAL})
    rows["mil-robot-head-video"] = Row("mil", ROBOT_HEAD)
    return rows


TABLE = Table("table1", "push", _rows(), shots=(1, 5))

if __name__ == "__main__":
    app.run(lambda _: tables.make(TABLE))
