"""Experts: plan every scene once by iLQR, then run the plan's feedback with noise on the actions.

The noise drives the arm off the plan and the recorded action is the feedback's answer, before the noise: a
demonstration so shows how to recover, and its labels are clean (DART, Laskey et al. 2017). Where iLQR does not plan
(no iterations) the feedback is the environment's controller, with a tactic that a rehearsal without noise chooses. An
expert by sampling (`demonstrations.py`) does the same with its own plans and its own way to follow them, one with a
receding horizon (`receding.py`) plans again where the noise has driven it, and one that has learned (`learned.py`) acts
in every state.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from milx.core import parallel
from milx.core.batching import map_in_chunks
from milx.envs.base import Env, State, Task
from milx.trajopt import demonstrations, learned, receding
from milx.trajopt.episode import judge, problem_of
from milx.trajopt.ilqr import Options, Plan, solve
from milx.trajopt.planner import Plans, Settings

VERSION = 3
"""Of all that plans, learns and demonstrates: raised when it does so differently with the same settings, so that no
demonstration planned before it is taken for one planned after it."""


def plan(env: Env, task: Task, state: State, options: Options) -> Plan:
    """Plans one episode from `state`: iLQR on the environment's costs, started from the environment's guess."""
    return solve(problem_of(env.differentiable, task, state), state.vector, env.guess(task, state), options)


class Sampling(NamedTuple):
    """An expert that plans whole episodes by sampling.

    Attributes:
        settings: of the planner.
        plans: of other scenes, with which it begins.
    """

    settings: Settings
    plans: Plans


class Learned(NamedTuple):
    """An expert that has learned.

    Attributes:
        settings: with which it learned.
        actor: what it learned.
    """

    settings: learned.Settings
    actor: learned.Actor


Expert = Options | Sampling | Learned | receding.Settings
"""Who demonstrates: iLQR, with no iterations of which the environment's controller does, or another expert."""
Feedback = Callable[[State, jax.Array], jax.Array]
"""Maps a state and the time step (int32 scalar) to an action [A]."""


def follow(plan: Plan) -> Feedback:
    """Makes the feedback that follows a plan linearly."""
    return lambda state, t: plan.actions[t] + plan.gains[t] @ (state.vector - plan.states[t])


def demonstrate(
    env: Env, task: Task, state: State, feedback: Feedback, key: jax.Array, noise: float
) -> tuple[State, jax.Array]:
    """Runs feedback from `state` with Gaussian noise of standard deviation `noise` on the actions.

    Args:
        env: the environment.
        task: what is to be done.
        state: the scene.
        feedback: who acts.
        key: draws the noise.
        noise: in units of the action.

    Returns:
        The states, with a leading axis T + 1, and the feedback's noiseless actions [T, A].
    """
    low, high = env.action_range

    def step(state: State, inputs: tuple[jax.Array, jax.Array]) -> tuple[State, tuple[State, jax.Array]]:
        t, key = inputs
        action = jnp.clip(feedback(state, t), low, high)
        after = env.step(task, state, action + noise * jax.random.normal(key, action.shape))
        return after, (state, action)

    keys = jax.random.split(key, env.horizon)
    last, (states, actions) = jax.lax.scan(step, state, (jnp.arange(env.horizon), keys))
    return jax.tree.map(lambda xs, x: jnp.concatenate([xs, x[None]]), states, last), actions


def perform(
    env: Env,
    task: Task,
    state: State,
    key: jax.Array,
    options: Expert,
    noise: float,
    tactic: np.ndarray | None = None,
) -> tuple[State, jax.Array]:
    """Demonstrates a batch by the expert that `options` describe.

    Not to be called inside `jax.jit`.

    Args:
        env: the environment.
        task: [N] what is to be done.
        state: [N] the scenes.
        key: [N] draw the noise.
        options: of iLQR, with no iterations of which the controller acts, or of another expert.
        noise: standard deviation of the noise, in units of the action.
        tactic: [N], the tactics of the controller; None for those that `choose_tactics` finds.

    Returns:
        As `demonstrate`, with a leading axis [N].

    Raises:
        ValueError: for no iterations in an environment without a controller.
    """
    if isinstance(options, receding.Settings):
        return receding.demonstrate(env, options, noise, task, state, key)
    if isinstance(options, Sampling):
        return demonstrations.demonstrate(env, options.settings, options.plans, noise, task, state, key)
    if isinstance(options, Learned):
        return _perform_learned(env, options.settings, options.actor, noise, task, state, key)
    if options.iterations:
        return _perform_planned(env, options, noise, task, state, key)
    if tactic is None:
        tactic = choose_tactics(env, options, task, state, len(key))
    return _perform_controlled(env, noise, task, state, tactic, key)


def choose_tactics(env: Env, options: Expert, task: Task, state: State, batch: int) -> np.ndarray | None:
    """Finds, for each of N scenes, the first tactic [N] with which the controller succeeds without noise.

    Where no tactic succeeds it is the first of all. Only scenes in which the tactics before have failed rehearse the
    next one. `batch` scenes rehearse at once. Other experts than the controller have none: it is None for them.
    """
    if not isinstance(options, Options) or options.iterations:
        return None
    chosen = np.full(len(state.qpos), env.tactics[0])
    unsolved = np.arange(len(chosen)) if len(env.tactics) > 1 else np.array([], int)

    def rehearse(tactic: float, task: Task, state: State) -> jax.Array:
        count = len(state.qpos)
        keys = jax.random.split(jax.random.key(0), count)  # of noise that is multiplied by zero
        states, _ = _perform_controlled(env, 0.0, task, state, np.full(count, tactic), keys)
        return judge(env, task, states)[0]

    for tactic in env.tactics:
        if len(unsolved):
            try_tactic = functools.partial(rehearse, tactic)
            success = np.asarray(map_in_chunks(try_tactic, (task, state), batch, counted=False, rows=unsolved))
            chosen[unsolved[success]] = tactic
            unsolved = unsolved[~success]
    return chosen


@functools.partial(jax.jit, static_argnums=(0, 1))
def _perform_planned(env: Env, options: Options, noise: float, *batch: Any) -> tuple[State, jax.Array]:
    def one(noise: float, task: Task, state: State, key: jax.Array) -> tuple[State, jax.Array]:
        return demonstrate(env, task, state, follow(plan(env, task, state, options)), key, noise)

    return parallel.shard_tasks(jax.vmap(one, in_axes=(None, 0, 0, 0)), shared=1)(noise, *batch)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _perform_learned(
    env: Env, settings: learned.Settings, actor: learned.Actor, noise: float, *batch: Any
) -> tuple[State, jax.Array]:
    def one(actor: learned.Actor, noise: float, task: Task, state: State, key: jax.Array) -> tuple[State, jax.Array]:
        return demonstrate(
            env, task, state, lambda state, _: learned.act(env, settings, actor, task, state), key, noise
        )

    return parallel.shard_tasks(jax.vmap(one, in_axes=(None, None, 0, 0, 0)), shared=2)(actor, noise, *batch)


@functools.partial(jax.jit, static_argnums=0)
def _perform_controlled(env: Env, noise: float, *batch: Any) -> tuple[State, jax.Array]:
    def one(noise: float, task: Task, state: State, tactic: jax.Array, key: jax.Array) -> tuple[State, jax.Array]:
        return demonstrate(env, task, state, lambda state, _: env.control(task, state, tactic), key, noise)

    return parallel.shard_tasks(jax.vmap(one, in_axes=(None, 0, 0, 0, 0)), shared=1)(noise, *batch)
