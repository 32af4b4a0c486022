"""What training starts from, data with their statistics and the first parameters, and what it goes on from."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from milx.config.schema import Config, ConvConfig
from milx.core.checkpoint import UNVALIDATED, Checkpoints
from milx.core.files import FileError
from milx.evaluation import provenance
from milx.methods.whitening import Whitening
from milx.networks import fixed_filters
from milx.training.start import start_from
from milx.training.update import Trainer, TrainState

PARTS = ("demos", "compile", "train", "evaluate", "total")
"""The parts of a run whose seconds are counted."""


class Training(NamedTuple):
    """What a run trains on.

    Attributes:
        dataset_hash: of the training demonstrations.
        whitening: their statistics.
        at: the data from which the scan that begins at a step draws its batches.
        first_images: [N, H, W, 3] uint8 of every camera, what some of the demonstrations show first.
    """

    dataset_hash: str
    whitening: Whitening
    at: Callable[[int], Any]
    first_images: Callable[[], list[np.ndarray]]


def check_steps(config: Config) -> None:
    """Raises ValueError unless training and validation come after whole numbers of scans."""
    for name in ("steps", "eval_every"):
        value, scan = getattr(config.train, name), config.train.log_every
        if value < 1 or value % scan:
            raise ValueError(f"train.{name}: got {value}, expected a positive multiple of train.log_every = {scan}")


def initial_state(
    trainer: Trainer, config: Config, training: Training, fresh: bool = True
) -> tuple[TrainState, jax.Array]:
    """Makes the state before the first meta-update on these demonstrations, and the key of the batches.

    Without `fresh` it has only the right shapes, for a run that goes on from a checkpoint.
    """
    init_key, batch_key = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), 3))
    state = trainer.init(init_key, training.whitening)
    if config.train.init is not None and fresh:
        state = dataclasses.replace(state, params=start_from(config.train.init, state.params, config))
    network = config.network
    if not isinstance(network, ConvConfig) or network.fixed_filters is None:
        return state, batch_key
    if network.fixed_filters == fixed_filters.KMEANS:
        filters = fixed_filters.cluster(training.first_images(), network)
    else:
        filters = fixed_filters.read_filters(network.fixed_filters, network)
    return dataclasses.replace(state, params=fixed_filters.put(state.params, filters)), batch_key


def save_state(
    write: Callable[..., bool], state: TrainState, score: float, seconds: dict[str, float], dataset_hash: str
) -> bool:
    """Writes a checkpoint from which `restore_state` goes on.

    Args:
        write: `Checkpoints.save` or `Checkpoints.replace`.
        state: what training has come to.
        score: of its validation, or UNVALIDATED.
        seconds: wall-clock by part, in s.
        dataset_hash: of the training demonstrations.

    Returns:
        Whether it is written.
    """
    items = {"params": state.params, "trainer": (state.step, state.optimizer)}
    extra = {"seconds": seconds, "dataset_hash": dataset_hash}
    extra["versions"] = provenance.versions(("milx", "jax", "orbax-checkpoint"))
    return write(int(state.step), items, score if np.isfinite(score) else UNVALIDATED, extra)


def restore_state(
    checkpoints: Checkpoints, step: int, state: TrainState, dataset_hash: str
) -> tuple[TrainState, dict[str, float]]:
    """Restores the state of a checkpoint, and the seconds spent until then.

    Args:
        checkpoints: of the run.
        step: which.
        state: the run's first, for structure and shapes.
        dataset_hash: of the demonstrations that there are now.

    Raises:
        ValueError: if the checkpoint was trained on other demonstrations, or does not hold this state.
    """
    like = {"params": state.params, "trainer": (state.step, state.optimizer)}
    items, extra = checkpoints.restore(step, like)
    hash_then, seconds = parse_extra(checkpoints, step, extra)
    if hash_then != dataset_hash:
        old, new = hash_then[:12], dataset_hash[:12]
        raise ValueError(
            f"workdir: {checkpoints.folder.parent} was trained on demonstrations {old}, but there are {new} now; "
            "expected the data set, or the device and versions that planned them, with which the run began, or another "
            "folder"
        )
    updates, optimizer = items["trainer"]
    return TrainState(updates, items["params"], optimizer), seconds


def parse_extra(checkpoints: Checkpoints, step: int, extra: dict[str, Any]) -> tuple[str, dict[str, float]]:
    """Takes the hash of the demonstrations, and the seconds by part, out of the extra values of a checkpoint.

    Parts that it does not name have taken no time.

    Raises:
        FileError: if they are not there.
    """
    digest, seconds = extra.get("dataset_hash"), extra.get("seconds")
    if not isinstance(digest, str) or not isinstance(seconds, dict):
        raise FileError(
            f"{checkpoints.folder / str(step)}: expected the run's dataset_hash and seconds beside the arrays"
        )
    if not all(isinstance(value, int | float) for value in seconds.values()):
        raise FileError(f"{checkpoints.folder / str(step)}: seconds: got {seconds!r:.200}, expected numbers")
    return digest, dict.fromkeys(PARTS, 0.0) | seconds
