"""An episode of an environment as a planning problem, in its actions or in other controls, and episodes judged."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from milx.core import parallel
from milx.envs.base import Env, State, Task
from milx.trajopt.ilqr import Problem


def problem_of(env: Env, task: Task, state: State) -> Problem:
    """States the problem of an episode from `state`: the environment's dynamics, costs and limits."""
    low, high = env.action_range
    return Problem(
        dynamics=lambda x, u: env.step(task, state.with_vector(x), u).vector,
        running_residual=lambda x, u, t: env.running_residual(task, state.with_vector(x), u, t),
        terminal_residual=lambda x: env.terminal_residual(task, state.with_vector(x)),
        control_low=low,
        control_high=high,
        approximation=lambda x, u: env.approximate_step(task, state.with_vector(x), u).vector,
    )


def with_controls(
    problem: Problem, law: Callable[[jax.Array, jax.Array], jax.Array], low: jax.Array, high: jax.Array
) -> Problem:
    """States a problem in other controls.

    Args:
        problem: in the model's own actions, to whose limits what the law computes is clipped. Every function of it
            calls the law anew.
        law: maps the state x [n] and controls [k] to actions [m], as the `action` of an environment's `Steering` does.
        low: the lowest controls [k].
        high: the highest controls [k].

    Returns:
        The problem of which controls minimize the same cost.
    """

    def acting(x: jax.Array, controls: jax.Array) -> jax.Array:
        return jnp.clip(law(x, controls), problem.control_low, problem.control_high)

    approximation = problem.approximation
    return Problem(
        dynamics=lambda x, u: problem.dynamics(x, acting(x, u)),
        running_residual=lambda x, u, t: problem.running_residual(x, acting(x, u), t),
        terminal_residual=problem.terminal_residual,
        control_low=low,
        control_high=high,
        approximation=approximation and (lambda x, u: approximation(x, acting(x, u))),
    )


def approximated(problem: Problem) -> Problem:
    """States a problem in the approximate dynamics that it has."""
    assert problem.approximation is not None, "every environment has one"
    return problem._replace(dynamics=problem.approximation)


def steered(env: Env, task: Task, state: State) -> Problem:
    """States the problem of an episode in the controls of the environment's steering."""
    steering = env.steering
    law = lambda x, u: steering.action(state.with_vector(x), u)  # noqa: E731
    return with_controls(problem_of(env, task, state), law, steering.low, steering.high)


@functools.partial(jax.jit, static_argnums=0)
def judge(env: Env, task: Task, states: State) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Judges a batch of episodes by success and by the environment's other criteria; all have a leading axis."""

    def one(task: Task, states: State) -> tuple[jax.Array, dict[str, jax.Array]]:
        return env.success(task, states), env.other_criteria(task, states)

    return parallel.shard_tasks(jax.vmap(one))(task, states)
