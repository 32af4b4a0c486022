"""Grasp, which the paper does not have, by method, with milx's additions; `published.py --table=grasp` has none.

Rows have the preset's 1,000 training tasks and 20,000 updates, or three times the tasks and twice the updates; those
with Muon have three times the tasks and 20,000 updates. MuJoCo Warp steps their world, so the extra `warp` is needed.

    python experiments/paper/grasp.py            # what is missing, then the table

Stopped and started again it goes on with its last checkpoint.
"""

import tables
from absl import app, flags
from tables import Row, Table

flags.adopt_module_key_flags(tables)

_WARP = {"env.physics": "warp"}
_MORE = _WARP | {"data.tasks": 3000, "train.steps": 40_000}
_MUON = _MORE | {"train.steps": 20_000, "optimizer.name": "muon"}
_BEGINNING = _MUON | {"train.frame_exponent": 2.0}
_OTHERS = _MUON | {"optimizer.learning_rate": 1e-3}

TABLE = Table(
    "grasp",
    "grasp",
    {
        "mil": Row("MIL + goal head, 1,000 tasks", "mil", _WARP),
        "lstm": Row("LSTM + goal head, 1,000 tasks", "lstm", _WARP),
        "contextual": Row("contextual + goal head, 1,000 tasks", "contextual", _WARP),
        "mil-3000": Row("MIL + goal head, 3,000 tasks", "mil", _MORE),
        "lstm-3000": Row("LSTM + goal head, 3,000 tasks", "lstm", _MORE),
        "contextual-3000": Row("contextual + goal head, 3,000 tasks", "contextual", _MORE),
        "mil-muon": Row("MIL + goal head, 3,000 tasks, Muon", "mil", _MUON),
        "mil-beginning": Row("MIL + goal head, 3,000 tasks, Muon, more of the beginning", "mil", _BEGINNING),
        "mil-frames": Row(
            "MIL + goal head, 3,000 tasks, Muon, more of the beginning, 16 time steps of the query",
            "mil",
            _BEGINNING | {"train.query_frames": 16},
        ),
        "lstm-muon": Row("LSTM + goal head, 3,000 tasks, Muon", "lstm", _OTHERS),
        "contextual-muon": Row("contextual + goal head, 3,000 tasks, Muon", "contextual", _OTHERS),
    },
    shots=(1,),
)

if __name__ == "__main__":
    app.run(lambda _: tables.make(TABLE))
