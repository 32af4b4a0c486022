"""Flags that all figures and tables share."""

import pathlib

from absl import flags

PRESET = flags.DEFINE_string("preset", "fast", "Hyperparameters of all that is not changed.")
STEPS = flags.DEFINE_integer("steps", None, "Meta-updates of each cell; default as in the script or cells.py.")
SEEDS = flags.DEFINE_integer("seeds", 2, "Seeds of each cell; tune.py has one.")
SHOW = flags.DEFINE_bool("show", False, "Print what there is, and run nothing.")
_OUT = flags.DEFINE_string("out", None, "Folder of the JSON files; default results/<script> beside the script.")


def folder(script: str) -> pathlib.Path:
    """Returns the folder of the JSON files."""
    return pathlib.Path(_OUT.value or pathlib.Path(__file__).parents[1] / "results" / script)
