"""Plans a scene by sampling, in any environment with costs, without a controller that knows the task.

In each scene a search (`sampling.py`) begins with the cheapest of the plans of the nearest scenes in which a plan
succeeded, and improves it. The plan is then executed: the robot returns to its path (`Env.steering`) while noise drives
it off, and every few steps what is left is planned again (`replanning.execute`). Candidates are rolled out by
`Env.approximate_step`, and what is executed happens by `Env.step`. The nearest scenes are those whose first states have
the most similar running residuals. `demonstrations.py` finds these plans, and demonstrates.

Reference:
    Laskey et al., "DART: noise injection for robust imitation learning", CoRL 2017 (the recorded action is the one
    without noise).
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

from milx.envs.base import Env, State, Task
from milx.trajopt import replanning, sampling
from milx.trajopt.episode import approximated, steered
from milx.trajopt.ilqr import Problem
from milx.trajopt.sampling import Options, Search

SEARCH = Options("cross_entropy", samples=32, iterations=8, order=3, elites=6, deviation_min=0.03)
AGAIN = Options("cross_entropy", samples=32, order=3, elites=6)
_LATER = 1
"""Seed of the candidates of what is planned again, the same in all scenes."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of demonstrations by sampling.

    Attributes:
        scenes: M, in which plans are searched for from nothing, for other scenes to begin with.
        from_nothing: iterations of those searches, rounded up to a multiple of `search.iterations`.
        rounds: how often these scenes begin again with each other's plans.
        search: how a plan is improved that begins with those of other scenes.
        again: how what is left of a plan is planned again, with a spline of the same order.
        every: number of time steps from one plan to the next. It is the largest divisor of the horizon that is at most
            this.
        knots: K, of a plan's spline; the horizon where that is shorter.
        near: deviation of candidates around a plan that is nearly right, as a fraction of the steering's.
        tried: number of plans that a scene tries first.

    Raises:
        ValueError: for a number that is out of range, or splines of two orders.
    """

    scenes: int = 256
    from_nothing: int = 24
    rounds: int = 4
    search: Options = SEARCH
    again: Options = AGAIN
    every: int = 5
    knots: int = 10
    near: float = 0.3
    tried: int = 64

    def __post_init__(self) -> None:
        for field in ("scenes", "from_nothing", "every", "knots", "tried"):
            if (value := getattr(self, field)) < 1:
                raise ValueError(f"{field}: got {value}, expected at least 1")
        if self.rounds < 0:
            raise ValueError(f"rounds: got {self.rounds}, expected at least 0")
        if self.near <= 0:
            raise ValueError(f"near: got {self.near}, expected more than 0")
        if self.again.order != self.search.order:
            raise ValueError(f"again.order: got {self.again.order}, expected search.order = {self.search.order}")


class Plans(NamedTuple):
    """Plans of M scenes.

    Attributes:
        features: [M, R], what `Planner.features` says of the scenes.
        knots: [M, K, k], of the controls.
        success: [M] bool, whether their execution succeeded.
    """

    features: jax.Array
    knots: jax.Array
    success: jax.Array


class Planner:
    """Plans in one scene, and executes what it planned. All methods are pure; `jax.vmap` gives batches.

    Args:
        env: the environment.
        settings: those of the planner.
    """

    def __init__(self, env: Env, settings: Settings):
        self.env, self.settings, self._steering = env, settings, env.steering

    def problem(self, task: Task, start: State) -> Problem:
        """States what is planned: the environment's costs, by its steering, in its approximate dynamics."""
        return approximated(steered(self.env, task, start))

    def features(self, task: Task, start: State) -> jax.Array:
        """Describes a scene by the running residual [R] of its first state, without an action."""
        return self.env.running_residual(task, start, jnp.zeros(self.env.action_size), jnp.int32(0))

    def begin(self) -> Search:
        """Begins a search without a plan."""
        knots = jnp.zeros((min(self.settings.knots, self.env.horizon), len(self._steering.low)))
        return sampling.start(knots, self._steering.deviation)

    def begin_from(self, task: Task, start: State, plans: Plans) -> Search:
        """Begins a search with the cheapest of the plans of the nearest scenes in which a plan succeeded.

        Where fewer than `tried` succeeded, the nearest of them takes the places of those that are missing, and where
        none did, the search begins with one that failed.
        """
        squares = jnp.square(plans.features - self.features(task, start)).sum(axis=1)
        squares = jnp.where(plans.success, squares, jnp.inf)
        _, nearest = jax.lax.top_k(-squares, min(self.settings.tried, len(squares)))
        nearest = jnp.where(plans.success[nearest], nearest, nearest[0])
        options, horizon = self.settings.search, self.env.horizon
        problem = self.problem(task, start)
        return sampling.start_from(problem, start.vector, plans.knots[nearest], self._near, horizon, options)

    def improve(self, task: Task, start: State, search: Search, key: jax.Array, iterations: int) -> Search:
        """Goes on with a search."""
        options = dataclasses.replace(self.settings.search, iterations=iterations)
        return sampling.solve(self.problem(task, start), start.vector, search, self.env.horizon, key, options)

    def execute(
        self, task: Task, start: State, search: Search, key: jax.Array, noise: jax.Array | float, tracking: bool = True
    ) -> tuple[State, jax.Array]:
        """Executes a plan; what is left of it is planned again with the same candidates in all scenes.

        Args:
            task: what is to be done.
            start: the scene.
            search: the plan.
            key: draws noise.
            noise: standard deviation of the noise on the actions, in their units.
            tracking: whether the robot returns to its path.

        Returns:
            The states, with a leading axis T + 1, and the actions without noise [T, A].
        """
        env, steering, settings = self.env, self._steering, self.settings

        def plant(
            x: jax.Array, controls: jax.Array, expected: jax.Array, key: jax.Array
        ) -> tuple[jax.Array, jax.Array]:
            state = start.with_vector(x)
            if tracking:
                controls = controls + steering.correction(state, start.with_vector(expected))
            action = jnp.clip(steering.action(state, controls), *env.action_range)
            noisy = action + noise * jax.random.normal(jax.random.fold_in(key, own), action.shape)
            return env.step(task, state, noisy).vector, action

        every = max(steps for steps in range(1, settings.every + 1) if env.horizon % steps == 0)
        search = search._replace(deviation=jnp.broadcast_to(self._near, search.deviation.shape))
        problem, own = self.problem(task, start), jax.random.bits(key)
        states, actions = replanning.execute(
            problem, start.vector, search, env.horizon, every, jax.random.key(_LATER), settings.again, plant
        )
        return jax.vmap(start.with_vector)(states), actions

    @property
    def _near(self) -> jax.Array:
        return self.settings.near * self._steering.deviation
