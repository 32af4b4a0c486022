"""Table 2 of the paper: push with one head, which is table 1's first row, and with another one for the inner loss.

    python experiments/paper/table2.py            # what is missing, then the table

Stopped and started again it goes on with its last checkpoint.
"""

import table1
import tables
from absl import app, flags
from tables import Row, Table

flags.adopt_module_key_flags(tables)

ONE_HEAD = "mil-video-state-action"
TABLE = Table(
    "table1",
    "push",
    {
        ONE_HEAD: table1.TABLE.rows[ONE_HEAD]._replace(label="MIL + goal head, one head", paper="80.6 / 82.6%"),
        "two-heads": Row("MIL + goal head, two heads", "mil", {"network.heads": 2}, "85.8 / 88.8%"),
    },
    shots=(1, 5),
)

if __name__ == "__main__":
    app.run(lambda _: tables.make(TABLE))
