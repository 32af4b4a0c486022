"""The run that a configuration asks for."""

import pathlib

from rich.console import Console

from milx.config import Config
from milx.recording import RECORDED, RecordedRun
from milx.run import Run
from milx.simulation import SimulatedRun


def make(config: Config, workdir: str | pathlib.Path, console: Console | None = None) -> Run:
    """A run on recorded demonstrations, or in the environment that `config.env_name` names."""
    kind = RecordedRun if config.env_name == RECORDED else SimulatedRun
    return kind(config, workdir, console)
