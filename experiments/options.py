"""Flags that all figures and tables share."""

import pathlib
from typing import Any

from absl import flags

PRESET = flags.DEFINE_string("preset", "fast", "Hyperparameters of all that is not changed.")
STEPS = flags.DEFINE_integer("steps", None, "Meta-updates of each cell; default as in the script or cells.py.")
SEEDS = flags.DEFINE_integer("seeds", 2, "Seeds of each cell; tune.py has one.")
SHOW = flags.DEFINE_bool("show", False, "Print what there is, and run nothing.")
_ROWS = flags.DEFINE_list("rows", None, "Which rows of a table; default all.")
_OUT = flags.DEFINE_string("out", None, "Folder of the JSON files; default results/<script> beside the script.")


def rows(table: dict[str, Any]) -> dict[str, Any]:
    """Those of a table's rows that were chosen, by name.

    Raises:
        ValueError: for a row that the table does not have; the message lists those that it has.
    """
    if unknown := sorted(set(_ROWS.value or ()) - set(table)):
        raise ValueError(f"rows: got {unknown[0]!r}, expected some of {', '.join(table)}")
    return {name: row for name, row in table.items() if _ROWS.value is None or name in _ROWS.value}


def folder(script: str) -> pathlib.Path:
    """Where the JSON files are."""
    return pathlib.Path(_OUT.value or pathlib.Path(__file__).parent / "results" / script)
