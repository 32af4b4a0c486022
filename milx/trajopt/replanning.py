"""Planning again while a plan by `sampling.py` is executed, where things turn out otherwise than planned.

`control` always looks T steps ahead (receding horizon), also beyond the end of an episode. `execute` executes one plan
of T steps to its end, and plans what is left of it again every few steps (shrinking horizon).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax

from milx.trajopt.ilqr import Problem
from milx.trajopt.sampling import Options, Search, actions_of, basis, knot_times, solve


def control(
    problem: Problem,
    initial_state: jax.Array,
    search: Search,
    horizon: int,
    steps: int,
    every: int,
    key: jax.Array,
    options: Options,
    plant: Callable[[jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array]] | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Executes the first actions of a plan, plans again from where they lead, and so on (receding horizon).

    The plan before is the next one's mean, moved on by the steps that were executed, and so is θ*; σ begins anew. A
    running residual is given the time since the first step, up to S + T - `every` - 1.

    Args:
        problem: what is planned.
        initial_state: x_0, [n].
        search: the first one.
        horizon: T, time steps that are planned ahead.
        steps: S, time steps that are executed, a multiple of `every`.
        every: time steps from one plan to the next.
        key: draws candidates, and what `plant` draws.
        options: settings.
        plant: (x [n], u [m], key) -> next x [n] and what was done [a], what happens; by default the problem's dynamics,
            and u.

    Returns:
        States [S + 1, n] and what was done [S, a].

    Raises:
        ValueError: if `steps` is not a multiple of `every`, or `every` is more than the horizon; if knots are held
            (order 0) for so long that a plan cannot be moved on by `every` steps.
    """
    knots = len(search.knots)
    if not 1 <= every <= horizon or steps % every:
        raise ValueError(f"every: got {every}, expected a divisor of steps = {steps}, at most horizon = {horizon}")
    if options.order == 0 and every * knots % horizon:
        held = f"{horizon / knots:g} time steps, for which a knot is held"
        raise ValueError(f"every: got {every}, expected a multiple of {held}")
    happens = plant or (lambda x, u, key: (problem.dynamics(x, u), u))
    later = knot_times(options.order, horizon, knots) + every
    search = jax.tree.map(lambda x: x.astype(initial_state.dtype), search)
    moved = jnp.asarray(basis(options.order, later, horizon, knots), initial_state.dtype)

    def act(x: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        u, key = inputs
        after, done = happens(x, u, key)
        return after, (after, done)

    def replan(carry, inputs):
        x, plan, best = carry
        now, key = inputs
        plan_key, act_key = jax.random.split(key)
        ahead = problem._replace(running_residual=lambda x, u, t: problem.running_residual(x, u, now + t))
        found = solve(ahead, x, search._replace(knots=plan, best=best), horizon, plan_key, options)
        actions = actions_of(problem, found.knots, horizon, options)[:every]
        x, executed = lax.scan(act, x, (actions, jax.random.split(act_key, every)))
        return (x, moved @ found.knots, moved @ found.best), executed

    times = jnp.arange(0, steps, every, dtype=jnp.int32)
    inputs = times, jax.random.split(key, len(times))
    _, (states, done) = lax.scan(replan, (initial_state, search.knots, search.best), inputs)
    states = jnp.concatenate([initial_state[None], states.reshape(steps, -1)])
    return states, done.reshape(steps, -1)


def execute(
    problem: Problem,
    initial_state: jax.Array,
    search: Search,
    horizon: int,
    every: int,
    key: jax.Array,
    options: Options,
    plant: Callable[[jax.Array, jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array]] | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Executes a plan to its end, and plans what is left again every `every` steps, from the state reached by then.

    Each time a search goes on around the last plan, θ* included, with the deviation of the given one. Before the first
    steps nothing is planned.

    Args:
        problem: what is planned.
        initial_state: x_0, [n].
        search: the plan.
        horizon: T, its time steps, all of which are executed.
        every: time steps from one plan to the next, a divisor of the horizon; the horizon itself to keep the plan.
        key: draws candidates, and what `plant` draws.
        options: settings of planning again, with the order of the given plan's spline.
        plant: (x [n], u [m], x̂ [n], key) -> next x [n] and what was done [a], what happens; by default the problem's
            dynamics, and u. x̂ is where the problem's dynamics take the last plan from the state in which it was made,
            so that a feedback law can return to it.

    Returns:
        States [T + 1, n] and what was done [T, a].

    Raises:
        ValueError: if `every` does not divide the horizon.
    """
    if not 1 <= every <= horizon or horizon % every:
        raise ValueError(f"every: got {every}, expected a divisor of horizon = {horizon}")
    happens = plant or (lambda x, u, expected, key: (problem.dynamics(x, u), u))
    search = jax.tree.map(lambda x: x.astype(initial_state.dtype), search)

    def act(
        now: tuple[jax.Array, jax.Array], inputs: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        (x, expected), (u, key) = now, inputs
        after, done = happens(x, u, expected, key)
        return (after, problem.dynamics(expected, u)), (after, done)

    def go_on(carry: tuple[jax.Array, Search], inputs: tuple[jax.Array, jax.Array]):
        x, plan = carry
        now, key = inputs
        plan_key, act_key = jax.random.split(key)
        if every < horizon:
            given = plan._replace(deviation=search.deviation)
            plan = lax.cond(now > 0, lambda: solve(problem, x, given, horizon, plan_key, options, now), lambda: given)
        actions = lax.dynamic_slice_in_dim(actions_of(problem, plan.knots, horizon, options), now, every)
        (x, _), executed = lax.scan(act, (x, x), (actions, jax.random.split(act_key, every)))
        return (x, plan), executed

    times = jnp.arange(0, horizon, every, dtype=jnp.int32)
    _, (states, done) = lax.scan(go_on, (initial_state, search), (times, jax.random.split(key, len(times))))
    states = jnp.concatenate([initial_state[None], states.reshape(horizon, -1)])
    return states, done.reshape(horizon, -1)
