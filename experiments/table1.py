"""Table 1 of the paper: push, by what the demonstrations show and how many of them there are.

    python experiments/table1.py                # what is missing, then the table
    python experiments/table1.py --rows=mil-video

Stopped and started again it goes on with the next cell.
"""

import cells
import tables
from absl import app, flags
from tables import Row, Table

from milx.config import GIVEN

flags.adopt_module_key_flags(tables)

TABLE = Table(
    "table1",
    "push",
    {
        f"{method}-{given.replace('+', '-')}": Row(
            method,
            {"mil.given": given, "network.learned_loss": "linear" if method == "mil" and given != GIVEN[0] else None},
        )
        for given in GIVEN
        for method in cells.METHODS["push"]
    },
    shots=(1, 5),
)

if __name__ == "__main__":
    app.run(lambda _: tables.make(TABLE))
