"""Evaluates a run's best checkpoint again on held-out tasks, beside the baselines and the upper bound.

    python -m milx.evaluate --workdir=runs/reach-mil-fast-0

This command writes evaluation.json and the plot in the run's folder anew, and the video if the run is in simulation.
"""

import pathlib

from absl import app, flags, logging

from milx.config import assemble
from milx.config.registry import load_plugins
from milx.core import platform
from milx.core.commands import command
from milx.training.factory import make_run

_WORKDIR = flags.DEFINE_string("workdir", None, "Folder of the run.", required=True)


def main(argv: list[str]) -> None:
    """Evaluates the run in --workdir."""
    if len(argv) > 1:
        raise app.UsageError(f"unexpected argument {argv[1]!r}")
    logging.set_verbosity(logging.ERROR)  # Orbax warns of things that milx does on purpose
    platform.configure()
    load_plugins()
    path = pathlib.Path(_WORKDIR.value) / "config.json"
    with command():
        if not path.is_file():
            raise ValueError(f"workdir: {path.parent} has no config.json, expected a folder of `python -m milx.train`")
        platform.require_device()
        run = make_run(assemble.read(path), path.parent)
        run.report(run.evaluate())


if __name__ == "__main__":
    app.run(main)
