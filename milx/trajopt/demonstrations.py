"""Demonstrations by sampling in batches of scenes, and the plans of other scenes with which their searches begin.

The first plans are searched from nothing (`find_plans`); then all of these scenes begin again with each other's
(`share_plans`), by which cheap plans spread and similar scenes get similar ones. All scenes that are demonstrated draw
the same candidates, too, so that a policy can learn what they have in common.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from milx.core import parallel
from milx.core.batching import map_in_chunks
from milx.envs.base import Env, State, Task
from milx.trajopt.episode import judge
from milx.trajopt.planner import Planner, Plans, Settings
from milx.trajopt.sampling import Search

_FIRST = 0
"""Seed of the candidates of searches that begin with plans, the same in all scenes."""


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
    return _execute(env, settings, jnp.asarray(noise, float), task, start, search, key)


class _Scenes(NamedTuple):
    """M training tasks with their scenes, searches that begin without a plan, and keys; nothing is planned yet."""

    task: Task
    start: State
    search: Search
    search_keys: jax.Array
    keys: jax.Array
    plans: Plans


@functools.partial(jax.jit, static_argnums=(0, 1))
def _drawn(env: Env, settings: Settings, key: jax.Array) -> _Scenes:
    planner = Planner(env, settings)

    def one(key: jax.Array) -> _Scenes:
        task_key, scene_key, search_key, key = jax.random.split(key, 4)
        task = env.sample_task(task_key, "train")
        start, search = env.reset(scene_key, task), planner.begin()
        plan = Plans(planner.features(task, start), search.knots, jnp.array(False))
        return _Scenes(task, start, search, search_key, key, plan)

    return jax.vmap(one)(jax.random.split(key, settings.scenes))


def no_plans(env: Env, settings: Settings, key: jax.Array) -> Plans:
    """Describes the M scenes of `find_plans` before anything is planned in them."""
    return _drawn(env, settings, key).plans


def find_plans(env: Env, settings: Settings, noise: jax.Array | float, key: jax.Array, batch: int) -> Plans:
    """Searches for a plan in each of M scenes, of as many training tasks, and executes it.

    Not to be called inside `jax.jit`. Its programs are those of `demonstrate` with the same settings in `batch` scenes,
    unless that is more than twice M: then all M are planned at once.

    Args:
        env: the environment.
        settings: of the planner, of which `scenes` is M.
        noise: standard deviation of the noise on the actions, in their units.
        key: draws tasks, scenes, noise, and the candidates of the searches.
        batch: number of scenes planned at once, as in `map_in_chunks`.

    Returns:
        The plans [M], those that failed among them.
    """
    scenes = _drawn(env, settings, key)

    def find(
        task: Task, start: State, search: Search, search_keys: jax.Array, keys: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        for number in range(-(-settings.from_nothing // settings.search.iterations)):
            search = _improve(env, settings, task, start, search, _numbered(search_keys, number))
        return search.knots, _succeeds(env, settings, noise, task, start, search, keys)

    knots, success = map_in_chunks(find, scenes[:-1], _at_once(settings, batch), counted=False)
    return scenes.plans._replace(knots=knots, success=success)


def share_plans(
    env: Env, settings: Settings, plans: Plans, noise: jax.Array | float, key: jax.Array, batch: int
) -> Plans:
    """Lets the scenes of `find_plans` begin again with each other's plans, in rounds.

    In each round every scene plans, beginning with the cheapest of the plans of the nearest scenes in which one
    succeeded, and takes what it finds for its plan if that succeeds. Without any plan that succeeded nothing can begin,
    and the plans are returned as they are. Not to be called inside `jax.jit`.

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
    scenes = _drawn(env, settings, key)

    def again(task: Task, start: State, keys: jax.Array) -> tuple[jax.Array, jax.Array]:
        search = _search_from(env, settings, plans, task, start)
        return search.knots, _succeeds(env, settings, noise, task, start, search, keys)

    inputs = scenes.task, scenes.start, _numbered(scenes.keys, 1 + number)
    knots, success = map_in_chunks(again, inputs, _at_once(settings, batch), counted=False)
    return plans._replace(knots=jnp.where(success[:, None, None], knots, plans.knots), success=plans.success | success)


def _at_once(settings: Settings, batch: int) -> int:
    """Returns how many of the M scenes are planned at once: as many as are demonstrated, or M if most were in vain."""
    return batch if batch <= 2 * settings.scenes else settings.scenes


def _search_from(env: Env, settings: Settings, plans: Plans, task: Task, start: State) -> Search:
    """Searches from the plans of others, with the same candidates in all scenes."""
    search = _begin_from(env, settings, parallel.replicate(plans), task, start)
    key = parallel.replicate(jnp.broadcast_to(jax.random.key(_FIRST), len(start.qpos)))
    return _improve(env, settings, task, start, search, key)


def _succeeds(
    env: Env,
    settings: Settings,
    noise: jax.Array | float,
    task: Task,
    start: State,
    search: Search,
    keys: jax.Array,
) -> jax.Array:
    """Executes N plans and tells which of them succeed, [N] bool."""
    states, _ = _execute(env, settings, jnp.asarray(noise, float), task, start, search, keys)
    return judge(env, task, states)[0]


@jax.jit
def _numbered(keys: jax.Array, number: int) -> jax.Array:
    """Derives other keys [N] from keys."""
    return jax.vmap(jax.random.fold_in, in_axes=(0, None))(keys, number)


# The three programs by which plans are found and shared and scenes are demonstrated. They are large, so all of this
# happens in batches of the same size, for which each is compiled once.


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
def _execute(env: Env, settings: Settings, noise: jax.Array, *batch: Any) -> tuple[State, jax.Array]:
    def one(noise: jax.Array, task: Task, start: State, search: Search, key: jax.Array) -> tuple[State, jax.Array]:
        return Planner(env, settings).execute(task, start, search, key, noise)

    return parallel.shard_tasks(jax.vmap(one, in_axes=(None, 0, 0, 0, 0)), shared=1)(noise, *batch)
