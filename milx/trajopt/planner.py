"""This module demonstrates by sampling, in any environment with costs, without a controller that knows the task.

In each scene a search (`sampling.py`) begins with the cheapest of the plans of the nearest scenes in which a plan
succeeded, and improves it. The plan is then executed: the robot returns to its path (`Env.steering`) while noise drives
it off, and every few steps what is left is planned again (`replanning.execute`). Candidates are rolled out by
`Env.approximate_step`, and what is executed happens by `Env.step`. The nearest scenes are those whose first states have
the most similar running residuals. The first plans are searched from nothing (`find_plans`); then all of these scenes
begin again with each other's (`share_plans`), by which cheap plans spread and similar scenes get similar ones. All
scenes that are demonstrated draw the same candidates, too, so that a policy can learn what they have in common.

Reference:
    Laskey et al., "DART: noise injection for robust imitation learning", CoRL 2017 (the recorded action is the one
    without noise).
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from milx.core import parallel
from milx.core.batching import map_in_chunks
from milx.envs.base import Env, State, Task
from milx.trajopt import replanning, sampling
from milx.trajopt.episode import approximated, steered
from milx.trajopt.ilqr import Problem
from milx.trajopt.sampling import Options, Search

SEARCH = Options("cross_entropy", samples=32, iterations=8, order=3, elites=6, deviation_min=0.03)
AGAIN = Options("cross_entropy", samples=32, order=3, elites=6)
_FIRST, _LATER = 0, 1
"""Seeds of the candidates of searches and of what is planned again, the same in all scenes."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of demonstrations by sampling.

    Attributes:
        scenes: M, in which plans are searched for from nothing, for other scenes to begin with.
        from_nothing: iterations of those searches, in multiples of `search.iterations`.
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


def demonstrate(
    env: Env,
    settings: Settings,
    plans: Plans,
    noise: jax.Array | float,
    task: Task,
    start: State,
    key: jax.Array,
) -> tuple[State, jax.Array]:
    """Demonstrates in a batch of N scenes, whose searches begin with the plans of others.

    Args:
        env: the environment.
        settings: of the planner.
        plans: of other scenes.
        noise: standard deviation of the noise on the actions, in their units.
        task: [N], what is to be done.
        start: [N], the scenes.
        key: [N], draw noise.

    Returns:
        The states, with leading axes [N, T + 1], and the actions without noise [N, T, A].
    """
    search = _search_from(env, settings, plans, task, start)
    states, actions, _ = _execute(env, settings, jnp.asarray(noise, float), task, start, search, key)
    return states, actions


def no_plans(env: Env, settings: Settings, key: jax.Array) -> Plans:
    """Describes the M scenes of `find_plans`, in which nothing has been planned."""
    return _drawn(env, settings, key)[-1]


def find_plans(env: Env, settings: Settings, noise: jax.Array | float, key: jax.Array, batch: int) -> Plans:
    """Searches for a plan in each of M scenes, of as many training tasks, and executes it.

    Its programs are those of `demonstrate` in `batch` scenes, unless that is more than twice M.

    Args:
        env: the environment.
        settings: of the planner, of which `scenes` is M.
        noise: standard deviation of the noise on the actions, in their units.
        key: draws tasks, scenes, noise, and the candidates of the searches.
        batch: scenes at once; the last ones are filled up.

    Returns:
        The plans [M], those that failed among them.
    """
    task, start, search, search_key, key, plans = _drawn(env, settings, key)

    def find(
        task: Task, start: State, search: Search, search_key: jax.Array, key: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        for number in range(-(-settings.from_nothing // settings.search.iterations)):
            search = _improve(env, settings, task, start, search, _numbered(search_key, number))
        return search.knots, _execute(env, settings, jnp.asarray(noise, float), task, start, search, key)[-1]

    size = min(batch, 2 * settings.scenes)
    knots, success = map_in_chunks(find, (task, start, search, search_key, key), size, counted=False)
    return plans._replace(knots=knots, success=success)


def share_plans(
    env: Env, settings: Settings, plans: Plans, noise: jax.Array | float, key: jax.Array, batch: int
) -> Plans:
    """Lets the scenes of `find_plans` begin again with each other's plans, in rounds.

    In each round every scene plans, beginning with the cheapest of the plans of the nearest scenes in which one
    succeeded, and takes what it finds for its plan if that succeeds. Without any plan that succeeded nothing can begin,
    and the plans are returned as they are.

    Args:
        env: the environment.
        settings: of the planner.
        plans: what `find_plans` returned for the other arguments.
        noise: standard deviation of the noise on the actions, in their units.
        key: draws tasks, scenes and noise.
        batch: as in `find_plans`.

    Returns:
        The plans [M].
    """
    if plans.success.any():
        for number in range(settings.rounds):
            plans = _shared(env, settings, plans, noise, key, number, batch)
    return plans


def _shared(
    env: Env, settings: Settings, plans: Plans, noise: jax.Array | float, key: jax.Array, number: int, batch: int
) -> Plans:
    """Runs one round of `share_plans`."""
    task, start, _, _, key, _ = _drawn(env, settings, key)

    def again(task: Task, start: State, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        search = _search_from(env, settings, plans, task, start)
        return search.knots, _execute(env, settings, jnp.asarray(noise, float), task, start, search, key)[-1]

    scenes = task, start, _numbered(key, 1 + number)
    knots, success = map_in_chunks(again, scenes, min(batch, 2 * settings.scenes), counted=False)
    return plans._replace(knots=jnp.where(success[:, None, None], knots, plans.knots), success=plans.success | success)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _drawn(env: Env, settings: Settings, key: jax.Array) -> tuple[Task, State, Search, jax.Array, jax.Array, Plans]:
    """Draws M training tasks with their scenes, and keys for searches and executions; begins all searches."""
    planner = Planner(env, settings)

    def one(key: jax.Array) -> tuple[Task, State, Search, jax.Array, jax.Array, Plans]:
        task_key, scene_key, search_key, key = jax.random.split(key, 4)
        task = env.sample_task(task_key, "train")
        start, search = env.reset(scene_key, task), planner.begin()
        return (
            task,
            start,
            search,
            search_key,
            key,
            Plans(planner.features(task, start), search.knots, jnp.array(False)),
        )

    return jax.vmap(one)(jax.random.split(key, settings.scenes))


_numbered = jax.jit(jax.vmap(jax.random.fold_in, in_axes=(0, None)))


# All that is planned goes through these three programs, so that each is compiled once. A search from nothing repeats
# the second.


def _search_from(env: Env, settings: Settings, plans: Plans, task: Task, start: State) -> Search:
    """Searches from the plans of others, with the same candidates in all scenes."""
    search = _begin_from(env, settings, parallel.replicate(plans), task, start)
    key = parallel.replicate(jnp.broadcast_to(jax.random.key(_FIRST), len(start.qpos)))
    return _improve(env, settings, task, start, search, key)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _begin_from(env: Env, settings: Settings, plans: Plans, task: Task, start: State) -> Search:
    def one(plans: Plans, task: Task, start: State) -> Search:
        return Planner(env, settings).begin_from(task, start, plans)

    return parallel.shard_tasks(jax.vmap(one, in_axes=(None, 0, 0)), shared=1)(plans, task, start)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _improve(env: Env, settings: Settings, *batch: Any) -> Search:
    improve = functools.partial(Planner(env, settings).improve, iterations=settings.search.iterations)
    return parallel.shard_tasks(jax.vmap(improve))(*batch)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _execute(env: Env, settings: Settings, noise: jax.Array, *batch: Any) -> tuple[State, jax.Array, jax.Array]:
    """Returns states, actions, and whether they succeed."""

    def one(
        noise: jax.Array, task: Task, start: State, search: Search, key: jax.Array
    ) -> tuple[State, jax.Array, jax.Array]:
        states, actions = Planner(env, settings).execute(task, start, search, key, noise)
        return states, actions, env.success(task, states)

    return parallel.shard_tasks(jax.vmap(one, in_axes=(None, 0, 0, 0, 0)), shared=1)(noise, *batch)
