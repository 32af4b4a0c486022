"""Table 3 of the paper: place, by method, by what the demonstrations show, and with ten times as many of them.

    python experiments/paper/table3.py            # what is missing, then the table

Stopped and started again it goes on with its last checkpoint.
"""

import tables
from absl import app, flags
from tables import Row, Table

flags.adopt_module_key_flags(tables)

TABLE = Table(
    "table3",
    "place",
    {
        "mil": Row("MIL + goal head", "mil", {}, "90%"),
        "mil-video": Row(
            "MIL + goal head, video", "mil", {"method.given": "video", "network.learned_loss": "linear"}, "68.3%"
        ),
        "mil-ten-times": Row("MIL + goal head, ten times as many demonstrations", "mil", {"data.tasks": 1500}),
        "lstm": Row("LSTM + goal head", "lstm", {}, "25%"),
        "contextual": Row("contextual + goal head", "contextual", {}, "25%"),
    },
    shots=(1,),
)

if __name__ == "__main__":
    app.run(lambda _: tables.make(TABLE))
