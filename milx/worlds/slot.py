"""One of the worlds that run side by side, and the episode in it."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from milx.data.cameras import fitted
from milx.deploy.policy import check_observation
from milx.types import Demo, Observation, Spec, black, from_fields
from milx.worlds.client import Client, WorldError

_STARTS = 3
"""Attempts to start a world, after which it is given up."""


class Task(NamedTuple):
    """A task of a world.

    Attributes:
        name: what the world's function is called with.
        family: the kind of task; tasks of one family differ in their goals.
        demos: what shows the task, [T, ...] each; none if the world itself demonstrates it.
    """

    name: str
    family: str = ""
    demos: tuple[Demo, ...] = ()


class Episode(NamedTuple):
    """An episode to run: what acts, the number of the task, and the seed of the reset."""

    control: str
    task: int
    seed: int


@dataclasses.dataclass
class Outcome:
    """What became of an episode.

    Attributes:
        episode: which.
        ever: whether the task was done at any time.
        end: whether it was done at the end.
        steps: how many were done.
        lost: why the episode could not be finished; None if it was. It does not count as a success.
        images: [H, W, 3] uint8 each, what was seen (with several cameras by name), of an episode that is filmed; else
            None.
    """

    episode: Episode
    ever: bool = False
    end: bool = False
    steps: int = 0
    lost: str | None = None
    images: list[Any] | None = None


class Slot:
    """One of the worlds that run side by side, and the episode in it.

    Args:
        connect: starts the world.
        spec: the sizes of what the policy sees and does.
        max_steps: after which an episode ends, if the world does not end it.

    Attributes:
        problem: why the world cannot be started; None if it can, as far as is known.
        outcome: of the episode that is to begin or under way; None if there is none.
        is_over: whether no episode is under way.
        observation: what was seen last.
    """

    def __init__(self, connect: Callable[[], Client], spec: Spec, max_steps: int):
        self._connect, self._spec, self._max_steps = connect, spec, max_steps
        self._client: Client | None = None
        self.problem: str | None = None
        self.outcome: Outcome | None = None
        self.is_over = True
        self.observation = _nothing(spec)

    def start(self) -> None:
        """Starts the world, if it is not there; if _STARTS attempts in a row fail, there are no more of them."""
        failures = 0
        while self._client is None and self.problem is None:
            try:
                self._client = self._connect()
            except WorldError as error:
                failures += 1
                if failures == _STARTS:
                    self.problem = f"the world could not be started in {_STARTS} attempts: {error}"

    def close(self) -> None:
        """Ends the world, which is not started again."""
        self.problem = self.problem or "the evaluation has ended"
        self._end()

    def _end(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client = None

    def demonstrated(self, task: Task, seed: int) -> Task:
        """Lets the world demonstrate a task that has no demonstration.

        Raises:
            WorldError: if the world cannot be started, fails, or shows no action.
        """
        if task.demos:
            return task
        _, shown = self._ask({"do": "demonstrate", "task": task.name, "seed": seed})
        if "action" not in shown:
            raise WorldError(f"demonstration of {task.name!r}: got {sorted(shown)}, expected an action, at least")
        image, state = _parts(shown, self._spec)
        return task._replace(demos=(Demo(image, state, np.asarray(shown["action"], np.float32)),))

    def begin(self, tasks: Sequence[Task]) -> None:
        """Resets the world if the episode has not begun."""
        if self.outcome is None or not self.is_over:
            return
        _, task, seed = self.outcome.episode
        try:
            self._see(self._ask({"do": "reset", "task": tasks[task].name, "seed": seed})[1])
        except WorldError as error:
            self._lose(error)
            return
        self.is_over = False

    def step(self, action: np.ndarray | None) -> None:
        """Does one step, if there is an episode; a random one without an action."""
        outcome = self.outcome
        if outcome is None or self.is_over:
            return
        try:
            if action is not None and not np.isfinite(action).all():
                raise WorldError(f"the policy's action is {action}, expected finite numbers")
            header, seen = self._ask({"do": "step"}, **({} if action is None else {"action": action}))
            self._see(seen)
        except WorldError as error:
            self._lose(error)
            return
        outcome.steps += 1
        outcome.end = header["success"]
        outcome.ever |= outcome.end
        self.is_over = header["ended"] or outcome.steps >= self._max_steps

    def _ask(self, request: dict[str, Any], **arrays: np.ndarray) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Asks the world, which is started if it is not there, and ended if it fails."""
        self.start()
        if self._client is None:
            raise WorldError(self.problem)
        try:
            return self._client.ask(request, **arrays)
        except WorldError:
            self._end()
            raise

    def _lose(self, error: WorldError) -> None:
        assert self.outcome is not None
        self.outcome.lost, self.outcome.ever, self.outcome.end = str(error), False, False
        self._end()
        self.is_over = True

    def _see(self, arrays: dict[str, np.ndarray]) -> None:
        """Takes what the policy sees; other sizes than the policy's are an error that ends the evaluation."""
        image, state = _parts(arrays, self._spec)
        if state is not None and not np.isfinite(state).all():
            raise WorldError(f"the state is {state}, expected finite numbers")
        self.observation = check_observation(Observation(image, state), self._spec)
        assert self.outcome is not None
        if self.outcome.images is not None and image is not None:
            self.outcome.images.append(image)


def _parts(arrays: dict[str, np.ndarray], spec: Spec) -> tuple[Any, np.ndarray | None]:
    """Takes what a policy sees out of an observation or a demonstration; larger images are shrunk as at import."""
    state = arrays.get("state")
    seen = np.asarray(state, np.float32) if spec.state_size and state is not None else None
    return fitted(from_fields(arrays), spec.image_shape), seen


def _nothing(spec: Spec) -> Observation:
    return Observation(black(spec.image_shape), np.zeros(spec.state_size, np.float32))
