"""The run that a configuration asks for."""

import pathlib

from rich.console import Console

from milx import envs
from milx.config.schema import Config
from milx.data import RECORDED
from milx.training.recorded import RecordedRun
from milx.training.run import Run


def make_run(config: Config, workdir: str | pathlib.Path, console: Console | None = None) -> Run:
    """Makes a run on recorded demonstrations, or in the environment that `config.env_name` names.

    Raises:
        ValueError: if there is no such environment, or MuJoCo is not installed. Also as the runs do.
    """
    if config.env_name == RECORDED:
        return RecordedRun(config, workdir, console)
    envs.find(config.env_name)  # MuJoCo, which the next line imports, may not be installed
    from milx.training.simulated import SimulatedRun

    return SimulatedRun(config, workdir, console)
