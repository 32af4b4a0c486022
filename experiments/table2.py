"""Table 2 of the paper: push with one head and with another one for the inner loss.

    python experiments/table2.py            # what is missing, then the table

Stopped and started again it goes on with the next cell.
"""

import tables
from absl import app, flags
from tables import Row, Table

flags.adopt_module_key_flags(tables)

TABLE = Table(
    "table2",
    "push",
    {"one-head": Row("mil", {"network.heads": 1}), "two-heads": Row("mil", {"network.heads": 2})},
    shots=(1, 5),
)

if __name__ == "__main__":
    app.run(lambda _: tables.make(TABLE))
