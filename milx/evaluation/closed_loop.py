"""Closed-loop evaluation on held-out tasks, with baselines and an upper bound beside the result.

One adaptation per task, on a demonstration whose own scene is never a trial scene; then trials in fresh scenes.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from milx.config.schema import Config, DataConfig, EvalConfig
from milx.core import parallel, platform
from milx.core.batching import map_in_chunks, map_in_groups
from milx.data.experts import expert_of
from milx.data.simulated import DemoSet, render_demo, shapes
from milx.envs.base import Env, State, Task
from milx.evaluation import listening
from milx.evaluation.intervals import bootstrap_interval, wilson_interval
from milx.evaluation.rollout import rollout
from milx.methods.base import Method
from milx.methods.random import Random
from milx.trajopt.episode import judge
from milx.types import Demo, Params, TaskParams

_LISTENERS = 24
"""Maximum number of held-out tasks on which `listen` measures."""
_PIXELS = 64_000_000
"""Pixels of demonstrations that a device adapts to at once: an inner step keeps all activations for its gradient."""


@functools.partial(jax.jit, static_argnums=(0, 3))
def trial_scenes(env: Env, task: Task, key: jax.Array, trials: int) -> State:
    """Draws the scenes of every task's trials: `task` has a leading axis [N], the result [N, trials]."""
    num_tasks = len(jax.tree.leaves(task)[0])
    keys = jax.random.split(key, (num_tasks, trials))
    return jax.vmap(jax.vmap(env.reset, in_axes=(0, None)))(keys, task)


class Trials(NamedTuple):
    """What became of the trials of N tasks.

    Attributes:
        success: [N, trials] bool.
        other: the same by the environment's other criteria.
        states: visited states, with leading axes [N, trials, T + 1].
    """

    success: jax.Array
    other: dict[str, jax.Array]
    states: State


@functools.cache
def _adaptation(env: Env, method: Method) -> Any:
    """Makes the program that adapts to demonstrations of N tasks: `states` and `action` have axes [N, K, T, ...]."""

    def adapt_tasks(params: Params, task: Task, states: State, action: jax.Array) -> TaskParams:
        def adapt(task: Task, states: State, action: jax.Array) -> TaskParams:
            observe = functools.partial(render_demo, env, task, chunk=method.chunk)
            return method.adapt(params, jax.vmap(observe)(states, action))

        return map_in_groups(adapt, (task, states, action), _tasks_at_once(env, action))

    adapt_shards = functools.wraps(adapt_tasks)(parallel.shard_tasks(adapt_tasks, shared=1))
    return jax.jit(adapt_shards, compiler_options=platform.pixel_options())


@functools.cache
def _acting(env: Env, method: Method) -> Any:
    """Makes the program in which the policies of N tasks act from scenes [N, trials]."""

    def run_tasks(task_params: TaskParams, task: Task, scene: State, key: jax.Array) -> Trials:
        def trial(task_params: TaskParams, task: Task, scene: State, key: jax.Array) -> Trials:
            visited, _ = rollout(env, method, task_params, task, scene, key)
            return Trials(env.success(task, visited), env.other_criteria(task, visited), visited)

        return jax.vmap(jax.vmap(trial, in_axes=(None, None, 0, 0)))(task_params, task, scene, key)

    run_shards = functools.wraps(run_tasks)(parallel.shard_tasks(run_tasks))
    return jax.jit(run_shards, compiler_options={} if env.long_chain else platform.pixel_options())


def _tasks_at_once(env: Env, action: jax.Array) -> int:
    """Computes how many tasks to run at once, of demonstrations [N, K, T, A]."""
    shots, length = action.shape[1:3]
    return _PIXELS // (shots * length * math.prod(env.image_shape)) if env.vision else len(action)


def run_trials(
    env: Env,
    method: Method,
    params: Params,
    demos: DemoSet,
    config: EvalConfig,
    key: jax.Array,
    misled: bool = False,
    first: int | None = None,
) -> Trials:
    """Runs every trial of every task in `demos`.

    Args:
        env: the environment.
        method: what adapts and acts.
        params: what it has learned.
        demos: held-out tasks; the policy adapts to the first `config.shots` demonstrations of each.
        config: trials, shots and batch.
        key: draws the trial scenes.
        misled: show each task's policy the next task's demonstrations instead, and judge it by its own task.
        first: number of trials of each task to run, the first ones; None for all.

    Returns:
        The success of every trial, and the states that it visited.
    """
    params = parallel.replicate(params)
    inputs = _trial_inputs(env, demos, key, config.shots, config.trials, misled, first)

    def run(task: Task, shown: Task, states: State, action: jax.Array, scene: State, keys: jax.Array) -> Trials:
        task_params = _adaptation(env, method)(params, shown, states, action)
        return _acting(env, method)(task_params, task, scene, keys)

    return map_in_chunks(run, inputs, config.batch)


@functools.partial(jax.jit, static_argnums=(0, 3, 4, 5, 6))
def _trial_inputs(
    env: Env, demos: DemoSet, key: jax.Array, shots: int, trials: int, misled: bool, first: int | None
) -> tuple[Task, Task, State, jax.Array, State, jax.Array]:
    """Returns each task, and what its policy is shown (task, states and actions) and starts from (scenes and keys)."""
    scene_key, act_key = jax.random.split(key)
    scene = trial_scenes(env, demos.task, scene_key, trials)
    keys = jax.random.split(act_key, (demos.num_tasks, trials))
    shown = jax.tree.map(lambda x: jnp.roll(x, -1, axis=0), demos) if misled else demos
    states, action = jax.tree.map(lambda x: x[:, :shots], (shown.states, shown.action))
    return demos.task, shown.task, states, action, *jax.tree.map(lambda x: x[:, :first], (scene, keys))


def precompile(env: Env, method: Method, params: Params, config: EvalConfig, trials: Sequence[int]) -> None:
    """Compiles what `run_trials` runs, for several numbers of trials, into the compilation cache.

    `params` may be shapes.
    """
    size = parallel.round_up(config.batch)
    params, batch = parallel.replicated_shapes((params, shapes(env, size, config.shots)))
    adaptation = _adaptation(env, method)
    shown = params, batch.task, batch.states, batch.action
    adaptation.lower(*shown).compile()
    task_params = parallel.replicated_shapes(jax.eval_shape(adaptation, *shown))
    for count in trials:
        inputs = _trial_inputs.eval_shape(env, batch, jax.random.key(0), config.shots, count, False, None)
        starts = parallel.replicated_shapes(inputs[-2:])
        _acting(env, method).lower(task_params, batch.task, *starts).compile()


@functools.partial(jax.jit, static_argnums=(0, 1))
def _compare(env: Env, method: Method, params: Params, adapted: TaskParams, demos: DemoSet) -> dict[str, jax.Array]:
    """Measures `listening.compare` on the first demonstration of each of N tasks."""

    def render(task: Task, states: State, action: jax.Array) -> Demo:
        return jax.vmap(functools.partial(render_demo, env, task, chunk=method.chunk))(states, action)

    query = parallel.shard_tasks(jax.vmap(render))(demos.task, demos.states, demos.action)
    return listening.compare(method, params, adapted, query, _tasks_at_once(env, demos.action))


def listen(env: Env, method: Method, params: Params, demos: DemoSet, config: EvalConfig) -> dict[str, float]:
    """Measures `listening.compare` on held-out tasks: adapts to their first demonstrations, asks for the next one's.

    Nothing where there are fewer than two tasks, or fewer tasks than devices.
    """
    count = _listeners(demos.num_tasks)
    if count < 2:
        return {}
    params = parallel.replicate(params)
    support, query = parallel.replicate(_support_and_query(demos, count, config.shots))
    adapt = functools.partial(_adaptation(env, method), params)
    adapted = map_in_chunks(adapt, (support.task, support.states, support.action), config.batch, counted=False)
    found = _compare(env, method, params, adapted, query)
    return {name: float(value) for name, value in found.items()}


@functools.partial(jax.jit, static_argnums=(1, 2))
def _support_and_query(demos: DemoSet, count: int, shots: int) -> tuple[DemoSet, DemoSet]:
    """Returns the first demonstrations of the first `count` tasks, and the next one of each."""
    task = jax.tree.map(lambda x: x[:count], demos.task)
    rest = demos.states, demos.action, demos.success
    parts = slice(shots), slice(shots, shots + 1)
    support, query = (DemoSet(task, *jax.tree.map(lambda x, part=part: x[:count, part], rest)) for part in parts)
    return support, query


def _listeners(num_tasks: int) -> int:
    """Computes on how many of so many tasks to measure: equally many on each device."""
    return min(num_tasks, _LISTENERS) // parallel.num_devices() * parallel.num_devices()


def precompile_listen(env: Env, method: Method, params: Params, config: EvalConfig) -> None:
    """Compiles what `listen` runs after an adaptation, into the compilation cache; `params` may be shapes."""
    if (count := _listeners(config.validation_tasks)) >= 2:
        params, support, query = parallel.replicated_shapes(
            (params, shapes(env, count, config.shots), shapes(env, count, 1))
        )
        shown = params, support.task, support.states, support.action
        adapted = parallel.replicated_shapes(jax.eval_shape(_adaptation(env, method), *shown))
        _compare.lower(env, method, params, adapted, query).compile()


class Baselines(NamedTuple):
    """Success rates of "random" actions, the "task_blind" expert, and the "expert".

    `summarize` adds the policy's own with another task's demonstration, "other_demo".

    Attributes:
        success: by name.
        other: the same by the environment's other criteria.
    """

    success: dict[str, float]
    other: dict[str, dict[str, float]]


def evaluate_baselines(env: Env, demos: DemoSet, config: EvalConfig, expert: DataConfig, key: jax.Array) -> Baselines:
    """Evaluates random actions, the task-blind expert and the expert in the same trials.

    They run in the first `config.baseline_trials` of every task's trials. The task-blind expert goes to a random
    candidate; the expert does without noise what it planned or rehearsed.

    Raises:
        ValueError: as `expert_of`.
    """
    num_trials = min(config.baseline_trials, config.trials)
    total = demos.num_tasks * num_trials  # said, as arrays without entries do not tell
    tasks, scenes, keys, as_it_is = _expert_inputs(env, demos.task, key, config.trials, num_trials)
    demonstrator = expert_of(env, expert)

    def plan(task: Task, state: State, key: jax.Array) -> tuple[State, jax.Array]:
        return demonstrator.perform(env, task, state, key, 0.0)

    states, _ = map_in_chunks(plan, (tasks, scenes, keys), expert.plan_batch)
    success, other = map_in_chunks(functools.partial(judge, env), (as_it_is, states), expert.plan_batch)
    random = run_trials(env, Random(env.action_size), {}, demos, config, key, first=num_trials)

    def rates(of_experts: jax.Array, of_random: jax.Array) -> dict[str, float]:
        halves = of_experts.reshape(2, total).mean(axis=1)
        return {
            "random": float(of_random.mean()),
            "task_blind": float(halves[0]),
            "expert": float(halves[1]),
        }

    return Baselines(rates(success, random.success), {name: rates(other[name], random.other[name]) for name in other})


@functools.partial(jax.jit, static_argnums=(0, 3, 4))
def _expert_inputs(
    env: Env, task: Task, key: jax.Array, trials: int, first: int
) -> tuple[Task, State, jax.Array, Task]:
    """Returns the first trials of N tasks, first for the task-blind expert and then for the expert, 2 N `first` in all.

    Both plan for the task as they believe it to be, and both are judged by the task as it is, which comes last.
    """
    total = len(jax.tree.leaves(task)[0]) * first
    scene = trial_scenes(env, task, jax.random.split(key)[0], trials)
    scene = jax.tree.map(lambda x: x[:, :first].reshape(total, *x.shape[2:]), scene)
    task = jax.tree.map(lambda x: jnp.repeat(x, first, axis=0), task)
    keys = jax.random.split(jax.random.fold_in(key, 1), total)
    believed = jax.vmap(env.task_blind)(keys, task)
    pairs = (believed, task), (scene, scene), (keys, keys), (task, task)
    tasks, scenes, keys, as_it_is = (jax.tree.map(lambda *xs: jnp.concatenate(xs), *pair) for pair in pairs)
    return tasks, scenes, keys, as_it_is


@functools.cache
def _filming(camera: Env) -> Any:
    """Makes the program of `film`."""
    return jax.jit(jax.vmap(camera.film), compiler_options=platform.pixel_options())


def film(camera: Env, task: Task, states: State) -> jax.Array:
    """Draws images [N, F, H, W, 3] uint8 of episodes of N tasks: `states` has leading axes [N, T + 1].

    `camera` is the environment with the wanted image size.
    """
    return _filming(camera)(task, states)


def precompile_film(camera: Env, num_tasks: int) -> None:
    """Compiles what `film` runs for so many tasks, into the compilation cache."""
    demos = shapes(camera, num_tasks, 1)
    states = jax.tree.map(lambda x: jax.ShapeDtypeStruct((num_tasks, *x.shape[2:]), x.dtype), demos.states)
    _filming(camera).lower(*parallel.replicated_shapes((demos.task, states))).compile()


def summarize(
    env: Env, config: Config, task: Task, trials: Trials, misled: Trials, baselines: Baselines
) -> dict[str, Any]:
    """Summarizes an evaluation for a result file: what was asked and what came out, by every criterion.

    Args:
        env: the environment.
        config: of the run.
        task: [N] what was tried.
        trials: after adaptation to each task's own demonstrations.
        misled: after adaptation to another task's, judged by the own task.
        baselines: what stands beside the results.
    """
    kind = np.asarray(jax.vmap(env.target_kind)(task))
    kind = np.where(kind < 0, np.arange(len(kind)), kind)

    def judged(success: jax.Array, baselines: dict[str, float], misled: jax.Array) -> dict[str, Any]:
        successes, trials = int(success.sum()), int(success.size)
        return {
            "success": successes / trials,
            "wilson95": list(wilson_interval(successes, trials)),
            "bootstrap95": list(bootstrap_interval(np.asarray(success), kind)),
            "baselines": {**baselines, "other_demo": float(misled.mean())},
        }

    other = {name: judged(success, baselines.other[name], misled.other[name]) for name, success in trials.other.items()}
    return {
        "env_version": env.version,
        "num_tasks_train": config.data.tasks,
        "num_demos_train": config.data.tasks * config.data.demos_per_task,
        "shots": config.evaluation.shots,
        "given": config.method.given if env.vision else config.method.given.removeprefix("video+"),
        "trials": int(trials.success.size),
        **judged(trials.success, baselines.success, misled.success),
        "criterion": env.criterion,
        **({"other_criteria": other} if other else {}),
    }
