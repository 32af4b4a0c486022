"""Grasp, which the paper does not have, by method, with milx's additions; `published.py --table=grasp` has none.

    python experiments/paper/grasp.py            # what is missing, then the table

Stopped and started again it goes on with its last checkpoint.
"""

import tables
from absl import app, flags
from tables import Row, Table

flags.adopt_module_key_flags(tables)

TABLE = Table(
    "grasp",
    "grasp",
    {
        "mil": Row("MIL + goal head", "mil", {}),
        "lstm": Row("LSTM + goal head", "lstm", {}),
        "contextual": Row("contextual + goal head", "contextual", {}),
    },
    shots=(1,),
)

if __name__ == "__main__":
    app.run(lambda _: tables.make(TABLE))
