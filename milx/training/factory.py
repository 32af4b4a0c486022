"""The run that a configuration asks for."""

import pathlib

from rich.console import Console

from milx.config.schema import Config
from milx.data import RECORDED
from milx.training.recorded import RecordedRun
from milx.training.run import Run
from milx.training.simulated import SimulatedRun


def make_run(config: Config, workdir: str | pathlib.Path, console: Console | None = None) -> Run:
    """Makes a run on recorded demonstrations, or in the environment that `config.env_name` names."""
    kind = RecordedRun if config.env_name == RECORDED else SimulatedRun
    return kind(config, workdir, console)
