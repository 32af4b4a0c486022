"""Metrics in Weights & Biases (wandb), beside those in the run's folder."""

import pathlib
import secrets
from typing import Any

from milx.config import assemble
from milx.config.schema import Config
from milx.core import files

_ID = "wandb_id"
"""The file in the run's folder with the name by which wandb knows the run."""
_PATIENCE = 60
"""Seconds that wandb may take to log in, or to send what is left."""


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

        path = folder / _ID
        if not path.is_file():
            files.write_bytes(path, secrets.token_hex(8).encode())
        settings = wandb.Settings(
            console="off", login_timeout=_PATIENCE, finish_timeout=_PATIENCE, finish_timeout_raises=True
        )
        self._run: Any = wandb.init(
            project=config.train.wandb,
            name=folder.name,
            id=files.read_bytes(path).decode(),
            resume="allow",
            reinit="create_new",  # one that somebody else has begun in this process stays theirs
            dir=str(folder),
            config=assemble.to_dict(config),
            settings=settings,
        )
        self._run.define_metric("*", step_metric="step")  # steps may come a second time in a run that goes on

    def log(self, step: int, values: dict[str, float]) -> None:
        """Hands one line of metrics over to wandb's own process."""
        self._run.log({"step": step, **values})

    def close(self, failed: bool) -> None:
        """Tells wandb how the run ended, and waits until everything is sent, for a minute at most."""
        self._run.finish(exit_code=int(failed))
