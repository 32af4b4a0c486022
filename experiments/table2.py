"""Table 2 of the paper: push with one head and with another one for the inner loss.

    python experiments/table2.py            # what is missing, then the table

Stopped and started again it goes on with the next cell.
"""

import push_tables
from absl import app, flags
from push_tables import Row

flags.adopt_module_key_flags(push_tables)

ROWS = {
    "one-head": Row("mil", {"network.heads": 1}),
    "two-heads": Row("mil", {"network.heads": 2}),
}

if __name__ == "__main__":
    app.run(lambda _: push_tables.make("table2", ROWS))
