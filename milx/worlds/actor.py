"""What acts in all worlds at once: the policy, and controls that tell what its success rests on."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from milx.data.dataset import spread
from milx.deploy.policy import Policy
from milx.types import Observation, TaskParams
from milx.worlds.slot import Episode, Outcome, Task

CONTROLS = {
    "own": "its own demonstration",
    "same_family": "another one's, same family",
    "other_family": "another family's",
    "unadapted": "no demonstration",
    "replay": "the demonstration replayed",
    "mean_action": "its mean action",
    "random": "random actions",
}
"""What acts, by name: the policy after a demonstration, or what stands beside it for comparison."""


def other_tasks(tasks: Sequence[Task], number: int) -> dict[str, int]:
    """Chooses whose demonstrations mislead a policy: the next task of the same family, and of another one.

    Tasks without demonstrations are passed over.
    """
    following = [(number + i) % len(tasks) for i in range(1, len(tasks))]
    others = [i for i in following if tasks[i].demos]
    same = [i for i in others if tasks[i].family == tasks[number].family]
    different = [i for i in others if tasks[i].family != tasks[number].family]
    return {name: found[0] for name, found in (("same_family", same), ("other_family", different)) if found}


class Actor:
    """What acts in all worlds at once.

    Args:
        policy: what is evaluated.
        tasks: of which at least one has demonstrations; the others take part in no episode.
        worlds: how many there are.
    """

    def __init__(self, policy: Policy, tasks: Sequence[Task], worlds: int):
        self._policy, self._tasks = policy, tasks
        self._others = [other_tasks(tasks, number) for number in range(len(tasks))]
        self._learned: dict[int | None, TaskParams] = {}
        self._adapt = jax.jit(policy.method.adapt)
        first = self._learn(min(number for number, task in enumerate(tasks) if task.demos))
        copies = lambda tree: jax.tree.map(lambda x: jnp.stack([x] * worlds), tree)  # noqa: E731
        self._task_params, self._memory = copies(first), copies(policy.initial_memory)
        self._act = jax.jit(jax.vmap(policy.method.act))

    def can(self, control: str, task: int) -> bool:
        """Tells whether a control exists for a task."""
        if control in ("same_family", "other_family"):
            return control in self._others[task]
        if control == "unadapted":
            return self._policy.method.unadapted(self._policy.params) is not None
        replayed = self._tasks[task].demos[:1] if control in ("replay", "mean_action") else ()
        return all(demo.action is not None for demo in replayed)

    def assign(self, world: int, episode: Episode) -> None:
        """Puts what acts in an episode in the place of what has acted in a world."""
        source = (
            None if episode.control == "unadapted" else self._others[episode.task].get(episode.control, episode.task)
        )
        put = lambda all, one: all.at[world].set(one)  # noqa: E731
        self._task_params = jax.tree.map(put, self._task_params, self._learn(source))
        self._memory = jax.tree.map(put, self._memory, self._policy.initial_memory)

    def act(self, observations: list[Observation], outcomes: list[Outcome | None]) -> list[np.ndarray | None]:
        """Returns an action for every world; None for a random one."""
        seen = jax.tree.map(lambda *parts: np.stack(parts), *observations)
        action, self._memory = self._act(self._task_params, seen, self._memory)
        return [self._chosen(outcome, mine) for outcome, mine in zip(outcomes, np.asarray(action), strict=True)]

    def _chosen(self, outcome: Outcome | None, action: np.ndarray) -> np.ndarray | None:
        if outcome is None or outcome.episode.control == "random":
            return None
        shown = self._tasks[outcome.episode.task].demos[0].action
        if outcome.episode.control == "replay":
            return np.asarray(shown[min(outcome.steps, len(shown) - 1)])
        if outcome.episode.control == "mean_action":
            return np.mean(shown, axis=0)
        return action

    def _learn(self, source: int | None) -> TaskParams:
        """Adapts to the demonstrations of a task; None for no adaptation."""
        if source not in self._learned:
            policy = self._policy
            if source is None:
                self._learned[None] = policy.method.unadapted(policy.params)
            else:
                resample = lambda x: np.asarray(x)[:, spread(x.shape[1], policy.horizon)]  # noqa: E731
                demos = [jax.tree.map(resample, policy.prepared(demo)) for demo in self._tasks[source].demos]
                shown = jax.tree.map(lambda *parts: np.concatenate(parts), *demos)
                self._learned[source] = self._adapt(policy.params, shown)
        return self._learned[source]
