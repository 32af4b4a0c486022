"""Metrics in Weights & Biases (wandb), beside those in the run's folder."""

import hashlib
import pathlib
from typing import Any

from milx.config import assemble
from milx.config.schema import Config


class Tracker:
    """A run in Weights & Biases, with the configuration; one that goes on is the same run there.

    Where it is sent, and whether, are settings of wandb's own: `wandb login`, WANDB_MODE=offline and so on.

    Args:
        folder: the run's, which gives the name.
        config: of the run; `train.wandb` is the project.

    Raises:
        ImportError: if the package wandb is missing.
        Exception: as `wandb.init`, for example where nobody has logged in.
    """

    def __init__(self, folder: pathlib.Path, config: Config):
        import wandb

        self._run: Any = wandb.init(
            project=config.train.wandb,
            name=folder.name,
            id=hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:16],
            resume="allow",
            dir=str(folder),
            config=assemble.to_dict(config),
            settings=wandb.Settings(console="off"),
        )
        self._run.define_metric("*", step_metric="step")  # steps may come a second time in a run that goes on

    def log(self, step: int, values: dict[str, float]) -> None:
        """Hands one line of metrics over to wandb's own process."""
        self._run.log({"step": step, **values})

    def close(self) -> None:
        """Waits until everything is sent."""
        self._run.finish()
