"""The loop of meta-training: scans on the device, and between them what is logged, saved and validated."""

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax

from milx.config.schema import TrainConfig
from milx.core import parallel, signals
from milx.core.checkpoint import UNVALIDATED, Checkpoints
from milx.training.state import PARTS, Training
from milx.training.update import TrainState

MOST_IN_VAIN = 100
"""Updates in a row that are not finite, after which training stops (at the end of the scan)."""

Scan = Callable[[TrainState, Any, jax.Array], tuple[TrainState, dict[str, jax.Array]]]
"""`Trainer.run`, compiled for `log_every` meta-updates."""


class Hooks(NamedTuple):
    """What the loop calls.

    Attributes:
        log: told the step and the metrics after every scan; "steps_per_s" is among them.
        validate: scores the parameters; the more the better. UNVALIDATED if that failed: training goes on.
        save: writes a checkpoint of a state with a score by `Checkpoints.save` or `Checkpoints.replace`, and says
            whether it could.
    """

    log: Callable[[int, dict[str, float]], None]
    validate: Callable[[TrainState], float]
    save: Callable[[Callable[..., bool], TrainState, float], bool]


class Clock:
    """Wall-clock by part, in s: "demos", "compile", "train", "evaluate", and the "total" since it was made."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(PARTS, 0.0)
        self._began = time.perf_counter()

    @contextlib.contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Adds the time spent within to a part."""
        began = time.perf_counter()
        yield
        self.seconds[name] += time.perf_counter() - began

    def elapsed(self) -> dict[str, float]:
        """Returns the seconds until now, earlier sessions included."""
        now = time.perf_counter()
        self.seconds["total"] += now - self._began
        self._began = now
        return dict(self.seconds)


def fit(
    scan: Scan,
    state: TrainState,
    key: jax.Array,
    training: Training,
    config: TrainConfig,
    checkpoints: Checkpoints,
    hooks: Hooks,
    clock: Clock,
    stop: signals.Stop,
) -> TrainState:
    """Trains from a state to the last step, or until `stop` is asked for.

    A checkpoint is saved before it is validated, and then once more with its score: a signal during a validation loses
    nothing but that.

    Args:
        scan: runs `config.log_every` meta-updates.
        state: where training starts or goes on.
        key: the key of the batches, from `initial_state`.
        training: the data.
        config: the number of updates, and how often to log and to validate.
        checkpoints: those of the run.
        hooks: what to call for logging, validation and saving.
        clock: counts the seconds of "train" and "evaluate".
        stop: whether the process was told to end.

    Returns:
        The state after the last update, or after the scan in which `stop` was asked for.

    Raises:
        ValueError: if MOST_IN_VAIN updates in a row were skipped because they were not finite, or the last checkpoint
            could not be written.
    """
    step, written, stopping, in_vain = int(state.step), True, False, 0

    def is_due() -> bool:
        return step % config.eval_every == 0 or step >= config.steps

    def validate() -> bool:
        with clock("evaluate"):
            score = hooks.validate(state)
        with stop.deferred():
            return hooks.save(checkpoints.replace, state, score)

    if step and is_due() and checkpoints.score(step) == UNVALIDATED:  # there was no time for it
        written = validate()
    while step < config.steps and not stopping:
        with stop.deferred():
            began = time.perf_counter()
            with clock("train"):
                state, metrics = scan(state, training.at(step), key)
                values = {name: float(value) for name, value in metrics.items()}
            step += config.log_every
            hooks.log(step, values | {"steps_per_s": config.log_every / (time.perf_counter() - began)})
            in_vain = in_vain + config.log_every if values["skipped"] == config.log_every else 0
            if in_vain >= MOST_IN_VAIN:
                last = f"the last good checkpoint is of step {checkpoints.latest}"
                there = last if checkpoints.latest is not None else "there is no checkpoint"
                raise ValueError(f"train: no update of the last {in_vain} was finite; {there}")
            stopping = parallel.on_any_host(bool(stop.asked))
            if is_due() or stopping:
                written = hooks.save(checkpoints.save, state, UNVALIDATED)
        if is_due():  # all there is has been saved
            stopping = parallel.on_any_host(bool(stop.asked))
            if written and not stopping:
                written = validate()
    if not written:
        latest, going_on = checkpoints.latest, "started again, the run goes on from there"
        raise ValueError(f"checkpoints: the last one that could be written is of step {latest}; {going_on}")
    return state
