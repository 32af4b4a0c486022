"""Experts: plan every scene once by iLQR, then run the plan's feedback with noise on the actions.

The noise drives the arm off the plan and the recorded action is the feedback's answer, before the noise: a
demonstration so shows how to recover, and its labels are clean (DART, Laskey et al. 2017). Where iLQR does not plan
(no iterations) the feedback is the environment's controller, with a tactic that a rehearsal without noise chooses.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from milx import parallel
from milx.envs.base import Env, State, Task
from milx.trajopt.ilqr import Options, Plan, Problem, solve


def plan(env: Env, task: Task, state: State, options: Options) -> Plan:
    """Plans one episode from `state`: iLQR on the environment's costs, started from the environment's guess."""
    low, high = env.action_range
    problem = Problem(
        dynamics=lambda x, u: env.step(task, state.with_vector(x), u).vector,
        running_residual=lambda x, u, t: env.running_residual(task, state.with_vector(x), u, t),
        terminal_residual=lambda x: env.terminal_residual(task, state.with_vector(x)),
        control_low=low,
        control_high=high,
    )
    return solve(problem, state.vector, env.guess(task, state), options)


def demonstrate(
    env: Env, task: Task, state: State, expert: Plan | jax.Array, key: jax.Array, noise: float
) -> tuple[State, jax.Array]:
    """Runs feedback from `state` with Gaussian noise of standard deviation `noise` on the actions.

    Args:
        env: the environment.
        task: what is to be done.
        state: the scene.
        expert: the plan whose feedback runs, or the tactic of the environment's controller.
        key: draws the noise.
        noise: in units of the action.

    Returns:
        The states, with a leading axis T + 1, and the feedback's noiseless actions [T, A].
    """
    low, high = env.action_range

    def feedback(state: State, planned: tuple | None) -> jax.Array:
        if not isinstance(expert, Plan):
            return env.control(task, state, expert)
        assert planned is not None
        nominal_state, nominal_action, gain = planned
        return nominal_action + gain @ (state.vector - nominal_state)

    def step(state: State, inputs: tuple) -> tuple[State, tuple[State, jax.Array]]:
        planned, key = inputs
        action = jnp.clip(feedback(state, planned), low, high)
        after = env.step(task, state, action + noise * jax.random.normal(key, action.shape))
        return after, (state, action)

    keys = jax.random.split(key, env.horizon)
    planned = (expert.states[:-1], expert.actions, expert.gains) if isinstance(expert, Plan) else None
    last, (states, actions) = jax.lax.scan(step, state, (planned, keys))
    return jax.tree.map(lambda xs, x: jnp.concatenate([xs, x[None]]), states, last), actions


def perform(
    env: Env, task: Task, state: State, key: jax.Array, options: Options, noise: float
) -> tuple[State, jax.Array]:
    """Plans and demonstrates a batch: `task`, `state` and `key` have a leading axis; so have the results."""
    if options.iterations:
        return _perform_planned(env, task, state, key, options, noise)
    return _perform_controlled(env, task, state, key, choose_tactics(env, task, state, key), noise)


def choose_tactics(env: Env, task: Task, state: State, key: jax.Array) -> np.ndarray:
    """[N] the first tactic with which the environment's controller succeeds in a rehearsal of each scene of a batch.

    Rehearsals are without noise. Where no tactic succeeds it is the first of all.
    """
    every = [np.full(len(key), tactic) for tactic in env.tactics]
    if len(every) == 1:
        return every[0]
    rehearsals = (_perform_controlled(env, task, state, key, each, 0.0)[0] for each in every)
    success = [np.asarray(judge(env, task, states)[0]) for states in rehearsals]
    return np.array(env.tactics)[np.argmax(success, axis=0)]


@functools.partial(jax.jit, static_argnums=(0, 4))
def _perform_planned(
    env: Env, task: Task, state: State, key: jax.Array, options: Options, noise: float
) -> tuple[State, jax.Array]:
    def one(noise: float, task: Task, state: State, key: jax.Array) -> tuple[State, jax.Array]:
        return demonstrate(env, task, state, plan(env, task, state, options), key, noise)

    return parallel.split_tasks(jax.vmap(one, in_axes=(None, 0, 0, 0)), shared=1)(noise, task, state, key)


@functools.partial(jax.jit, static_argnums=0)
def _perform_controlled(
    env: Env, task: Task, state: State, key: jax.Array, tactic: np.ndarray, noise: float
) -> tuple[State, jax.Array]:
    def one(noise: float, task: Task, state: State, tactic: jax.Array, key: jax.Array) -> tuple[State, jax.Array]:
        return demonstrate(env, task, state, tactic, key, noise)

    in_axes = (None, 0, 0, 0, 0)
    return parallel.split_tasks(jax.vmap(one, in_axes=in_axes), shared=1)(noise, task, state, tactic, key)


@functools.partial(jax.jit, static_argnums=0)
def judge(env: Env, task: Task, states: State) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Success of a batch of episodes, and success by the environment's other criteria; all have a leading axis."""

    def one(task: Task, states: State) -> tuple[jax.Array, dict[str, jax.Array]]:
        return env.success(task, states), env.other_criteria(task, states)

    return parallel.split_tasks(jax.vmap(one))(task, states)
