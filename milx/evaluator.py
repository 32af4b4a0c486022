"""Closed-loop evaluation on held-out tasks, with floors and a ceiling beside the result.

One adaptation per task, on a demonstration whose own scene is never a trial scene; then trials in fresh scenes.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from milx.chunks import map_in_chunks
from milx.config import DataConfig, EvalConfig
from milx.data.demos import DemoSet, render_demo
from milx.envs.base import Env, State, Task
from milx.methods.base import Method
from milx.methods.random import Random
from milx.rollout import rollout
from milx.trajopt.expert import perform
from milx.trajopt.ilqr import Options
from milx.types import Params


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's score interval of a success rate (Wilson 1927); 95% by default."""
    rate, spread = successes / trials, z * z / trials
    centre = (rate + spread / 2) / (1 + spread)
    half = math.sqrt(rate * (1 - rate) * spread + spread * spread / 4) / (1 + spread)
    return max(centre - half, 0.0), min(centre + half, 1.0)


def trial_scenes(env: Env, task: Task, key: jax.Array, trials: int) -> State:
    """Draws the scenes of every task's trials: `task` has a leading axis [N], the result [N, trials]."""
    num_tasks = len(jax.tree.leaves(task)[0])
    keys = jax.random.split(key, (num_tasks, trials))
    return jax.vmap(jax.vmap(env.reset, in_axes=(0, None)))(keys, task)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _success(
    env: Env, method: Method, params: Params, task: Task, states: State, action: jax.Array, scene: State, key: jax.Array
) -> jax.Array:
    """[N, trials] successes after adapting to demonstrations [N, K, T, ...]."""

    def evaluate_task(task: Task, states: State, action: jax.Array, scene: State, key: jax.Array) -> jax.Array:
        demo = jax.vmap(functools.partial(render_demo, env, task))(states, action)
        task_params = method.adapt(params, demo)

        def trial(scene: State, key: jax.Array) -> jax.Array:
            return env.success(task, rollout(env, method, task_params, task, scene, key)[0])

        return jax.vmap(trial)(scene, key)

    return jax.vmap(evaluate_task)(task, states, action, scene, key)


def success_table(
    env: Env, method: Method, params: Params, demos: DemoSet, config: EvalConfig, key: jax.Array
) -> jax.Array:
    """Success of every trial of every task in `demos`.

    Args:
        env: the environment.
        method: what adapts and acts.
        params: what it has learnt.
        demos: held-out tasks; the policy adapts to the first `config.shots` demonstrations of each.
        config: trials, shots and batch.
        key: draws the trial scenes.

    Returns:
        [N, trials] bool.
    """
    scene_key, act_key = jax.random.split(key)
    scene = trial_scenes(env, demos.task, scene_key, config.trials)
    support = jax.tree.map(lambda x: x[:, : config.shots], (demos.states, demos.action))
    keys = jax.random.split(act_key, (demos.num_tasks, config.trials))
    inputs = (demos.task, *support, scene, keys)
    return map_in_chunks(functools.partial(_success, env, method, params), inputs, config.batch)


def baselines(env: Env, demos: DemoSet, config: EvalConfig, expert: DataConfig, key: jax.Array) -> dict[str, float]:
    """Success rates in the same trials of: random actions, the task-blind expert, and the expert.

    The task-blind expert goes to a random candidate; the expert runs its plan without noise.
    """
    options = Options(iterations=expert.plan_iterations)
    scene = trial_scenes(env, demos.task, jax.random.split(key)[0], config.trials)
    task = jax.tree.map(lambda x: jnp.repeat(x, config.trials, axis=0), demos.task)
    scene = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), scene)
    keys = jax.random.split(jax.random.fold_in(key, 1), len(jax.tree.leaves(scene)[0]))

    def expert_success(believed: Task) -> float:
        """Success at `task` of an expert who takes the task for `believed`."""
        states, _ = map_in_chunks(
            lambda *chunk: perform(env, *chunk, options, 0.0), (believed, scene, keys), expert.plan_batch
        )
        return float(jax.jit(jax.vmap(env.success))(task, states).mean())

    random = success_table(env, Random(env.action_size), (), demos, config, key)
    return {
        "random": float(random.mean()),
        "task_blind": expert_success(jax.vmap(env.task_blind)(keys, task)),
        "expert": expert_success(task),
    }


def film(
    env: Env, camera: Env, method: Method, params: Params, demos: DemoSet, key: jax.Array
) -> tuple[np.ndarray, np.ndarray]:
    """Films one demonstration of each task, and one trial after adapting to it.

    Args:
        env: what the policy sees and acts in.
        camera: the same environment with larger images.
        method: what adapts and acts.
        params: what it has learnt.
        demos: N tasks.
        key: draws the trial scenes.

    Returns:
        Images [N, T, H, W, 3] uint8 of the demonstrations and of the trials.
    """

    def film_task(task: Task, states: State, action: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        demo = jax.tree.map(lambda x: x[None], render_demo(env, task, states, action))
        visited, _ = rollout(env, method, method.adapt(params, demo), task, env.reset(key, task), key)
        shots = [render_demo(camera, task, path, action).image for path in (states, visited)]
        return shots[0], shots[1]

    keys = jax.random.split(key, demos.num_tasks)
    first = jax.tree.map(lambda x: x[:, 0], (demos.states, demos.action))
    demo, trial = jax.jit(jax.vmap(film_task))(demos.task, *first, keys)
    return np.asarray(demo), np.asarray(trial)


def summary(table: jax.Array) -> dict[str, Any]:
    """Trials, success rate and its interval from [N, trials] successes."""
    successes, trials = int(table.sum()), int(table.size)
    return {"trials": trials, "success": successes / trials, "wilson95": list(wilson_interval(successes, trials))}
