"""iLQR against a Riccati recursion, a convex solver, finite differences and its own laws."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linear_quadratic import bounded_least_squares, lq_problem, random_lq, riccati

from milx.trajopt import ilqr

SEEDS = 5


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@functools.partial(jax.jit, static_argnums=2)
def solve_lq(lq, limit, options):
    return jax.vmap(lambda lq: ilqr.solve(lq_problem(lq, limit), lq["x_0"], lq["guess"], options))(lq)


@pytest.fixture(scope="module")
def lqs():
    return [random_lq(seed) for seed in range(SEEDS)]


@pytest.fixture(scope="module")
def stacked_lqs(lqs):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *lqs)


def test_one_iteration_solves_lq_as_riccati_does(lqs, stacked_lqs):
    plans = solve_lq(stacked_lqs, np.inf, ilqr.Options(regularization=0.0))
    np.testing.assert_array_equal(plans.iterations, 1)
    assert plans.converged.all()
    for i, lq in enumerate(lqs):
        states, actions, gains = riccati(lq)
        np.testing.assert_allclose(plans.states[i], states, atol=1e-9)
        np.testing.assert_allclose(plans.actions[i], actions, atol=1e-9)
        np.testing.assert_allclose(plans.gains[i], gains, atol=1e-9)


@pytest.mark.slow
def test_derivatives_of_a_coarse_model_lead_to_nearly_the_optimal_cost(lqs):
    # Errors of 3% in A and B: the cost of what is found, in the true dynamics, misses the optimum by their square.
    error = np.random.default_rng(7).uniform(-0.03, 0.03, (2, 4, 4))
    options = ilqr.Options(iterations=100, tolerance=1e-10)
    for lq in (jax.tree.map(jnp.asarray, lq) for lq in lqs):
        exact = lq_problem(lq, np.inf)
        A, B = lq["A"] * (1 + error[0]), lq["B"] * (1 + error[1, :, :2])
        coarse = exact._replace(approximation=lambda x, u, A=A, B=B: A @ x + B @ u)
        best, found = (ilqr.solve(problem, lq["x_0"], lq["guess"], options) for problem in (exact, coarse))
        assert best.cost <= found.cost <= 1.01 * best.cost
        x = lq["x_0"]
        for u, after in zip(found.actions, found.states[1:], strict=True):
            x = lq["A"] @ x + lq["B"] @ u
            np.testing.assert_allclose(after, x, atol=1e-9)


def test_expected_change_of_lq_is_exact(lqs):
    # Whatever μ and α are: μ changes the policy, and the expected change is that of the policy found.
    lq = jax.tree.map(jnp.asarray, lqs[0])
    problem = lq_problem(lq, np.inf)

    @jax.jit
    def change(mu, alpha):
        idle = ilqr._Policy(jnp.zeros((15, 2)), jnp.zeros((15, 2, 4)), jnp.zeros(2))
        start = jnp.broadcast_to(lq["x_0"], (16, 4))
        states, actions, cost = ilqr._forward(problem, start, lq["guess"], idle, 0.0)
        policy = ilqr._backward(problem, states, actions, mu)
        _, _, new_cost = ilqr._forward(problem, states, actions, policy, alpha)
        return new_cost - cost, policy.change @ jnp.array([alpha, alpha**2])

    for mu, alpha in [(0.0, 1.0), (0.0, 0.3), (5.0, 1.0), (5.0, 0.1)]:
        np.testing.assert_allclose(*change(mu, alpha), rtol=1e-9)


def test_limited_lq_reaches_the_convex_optimum(lqs, stacked_lqs):
    limit = 0.6
    plans = solve_lq(stacked_lqs, limit, ilqr.Options(iterations=200, tolerance=1e-12))
    assert plans.converged.all()
    for i, lq in enumerate(lqs):
        actions, cost, gradient = bounded_least_squares(lq, limit)
        held = np.abs(gradient) > 1e-3
        assert 0.2 < held.mean() < 0.8
        np.testing.assert_allclose(plans.cost[i], cost, rtol=1e-9)
        np.testing.assert_allclose(plans.actions[i], actions, atol=1e-4)
        # No feedback where a limit holds the action back, feedback elsewhere.
        np.testing.assert_array_equal(np.any(plans.gains[i] != 0, axis=-1), ~held)


# The swing-up of a pendulum: nonlinear, with limits too weak to lift it at once.

T, H, LIMIT = 60, 0.05, 4.0


def pendulum(x, u):
    """Steps by semi-implicit Euler; the angle is zero upright, gravity 9.81, mass and length 1."""
    angle, velocity = x
    velocity = velocity + H * (9.81 * jnp.sin(angle) - 0.05 * velocity + u[0])
    return jnp.stack([angle + H * velocity, velocity])


def upright(x):
    return jnp.stack([jnp.sin(x[0]), 1 - jnp.cos(x[0]), 0.3 * x[1]])


def pendulum_problem(dynamics=pendulum):
    return ilqr.Problem(
        dynamics=dynamics,
        running_residual=lambda x, u, t: jnp.concatenate([0.1 * upright(x), 0.05 * u]),
        terminal_residual=lambda x: 10 * upright(x),
        control_low=jnp.array([-LIMIT]),
        control_high=jnp.array([LIMIT]),
    )


GUESS = np.sin(0.3 * np.arange(T))[:, None]
STARTS = np.array([[np.pi, 0.0], [2.0, 1.0], [-3.0, 0.5], [0.3, 0.0]])


def rollout_cost(actions, start, gains=None, states=None):
    """Computes J by an independent rollout in NumPy, open-loop or with feedback."""
    x, cost = np.array(start), 0.0
    residual = lambda x: np.array([np.sin(x[0]), 1 - np.cos(x[0]), 0.3 * x[1]])  # noqa: E731
    for t, u in enumerate(np.asarray(actions)):
        if gains is not None:
            u = np.clip(u + gains[t] @ (x - states[t]), -LIMIT, LIMIT)
        cost += 0.5 * (np.sum((0.1 * residual(x)) ** 2) + np.sum((0.05 * u) ** 2))
        velocity = x[1] + H * (9.81 * np.sin(x[0]) - 0.05 * x[1] + u[0])
        x = np.array([x[0] + H * velocity, velocity])
    return cost + 0.5 * np.sum((10 * residual(x)) ** 2)


@functools.partial(jax.jit, static_argnums=1)
def solve_pendulum(start, options=None):
    return ilqr.solve(pendulum_problem(), start, jnp.asarray(GUESS, start.dtype), options)


@pytest.fixture(scope="module")
def swing_ups():
    options = ilqr.Options(iterations=300, tolerance=1e-13)
    return [solve_pendulum(jnp.asarray(start), options) for start in STARTS]


def test_cost_never_rises():
    # Without regularization the full step, the only one here, at times makes things worse: then the plan stays.
    def cost_after(iterations):
        options = ilqr.Options(iterations=iterations, step_sizes=(1.0,), regularization=0.0)
        return ilqr.solve(pendulum_problem(), jnp.asarray(STARTS[0]), jnp.asarray(GUESS), options).cost

    costs = np.asarray(jax.jit(jax.vmap(cost_after))(jnp.arange(40)))
    np.testing.assert_allclose(costs[0], rollout_cost(GUESS, STARTS[0]), rtol=1e-12)
    change = np.diff(costs)
    assert np.all(change <= 0)
    rejected, improved = np.flatnonzero(change == 0), np.flatnonzero(change < 0)
    assert rejected.size > 0
    assert rejected.min() < improved.max()
    assert costs[-1] < 0.05 * costs[0]


def test_plans_are_rollouts_within_limits(swing_ups):
    for start, plan in zip(STARTS, swing_ups, strict=True):
        assert np.abs(plan.actions).max() <= LIMIT
        np.testing.assert_allclose(plan.cost, rollout_cost(plan.actions, start), rtol=1e-10)
    assert any(np.abs(plan.actions).max() == LIMIT for plan in swing_ups)


def test_plans_are_stationary(swing_ups):
    """Compares with central differences of the whole cost: zero inside the limits, pushing outwards on them."""
    epsilon = 1e-5
    for start, plan in zip(STARTS, swing_ups, strict=True):
        assert plan.converged
        actions = np.asarray(plan.actions)

        def gradient(actions, start=start):
            steps = epsilon * np.eye(T)[:, :, None]
            return np.array([rollout_cost(actions + e, start) - rollout_cost(actions - e, start) for e in steps]) / (
                2 * epsilon
            )

        scale = np.abs(gradient(GUESS)).max()
        slope, actions = gradient(actions), actions[:, 0]
        np.testing.assert_allclose(slope[np.abs(actions) < LIMIT] / scale, 0, atol=1e-5)
        assert np.all(slope[actions == LIMIT] < 1e-5 * scale)
        assert np.all(slope[actions == -LIMIT] > -1e-5 * scale)


def test_expected_change_is_the_slope_of_the_line_search():
    problem = pendulum_problem()

    @jax.jit
    def line(alphas):
        idle = ilqr._Policy(jnp.zeros((T, 1)), jnp.zeros((T, 1, 2)), jnp.zeros(2))
        start = jnp.broadcast_to(STARTS[1], (T + 1, 2))
        states, actions, _ = ilqr._forward(problem, start, jnp.asarray(GUESS), idle, 0.0)
        policy = ilqr._backward(problem, states, actions, 0.1)
        costs = jax.vmap(lambda alpha: ilqr._forward(problem, states, actions, policy, alpha)[2])(alphas)
        return costs, policy.change[0]

    # The derivative on the side of positive α, to second order.
    epsilon = 1e-5
    costs, slope = line(epsilon * jnp.arange(3))
    np.testing.assert_allclose((-3 * costs[0] + 4 * costs[1] - costs[2]) / (2 * epsilon), slope, rtol=1e-5)


def test_feedback_recovers_from_a_push(swing_ups):
    # The push changes the start by 0.05 rad; the optimum from there is the yardstick.
    start = STARTS[1] + np.array([0.05, 0.0])
    plan = swing_ups[1]
    best = solve_pendulum(jnp.asarray(start), ilqr.Options(iterations=300, tolerance=1e-13)).cost
    open_loop = rollout_cost(plan.actions, start) - best
    closed_loop = rollout_cost(plan.actions, start, np.asarray(plan.gains), np.asarray(plan.states)) - best
    assert closed_loop < 0.1 * open_loop


def test_vmapped_solve_equals_a_loop(swing_ups):
    options = ilqr.Options(iterations=300, tolerance=1e-13)
    batch = jax.vmap(lambda start: solve_pendulum(start, options))(STARTS)
    assert len(set(batch.iterations.tolist())) > 1
    for i, plan in enumerate(swing_ups):
        assert batch.iterations[i] == plan.iterations
        np.testing.assert_allclose(batch.cost[i], plan.cost, rtol=1e-9)
        np.testing.assert_allclose(batch.states[i], plan.states, atol=1e-6)


def test_float32_reaches_the_cost_of_float64(swing_ups):
    with jax.enable_x64(False):
        for start, exact in zip(STARTS, swing_ups, strict=True):
            plan = solve_pendulum(jnp.asarray(start, jnp.float32))
            assert plan.converged
            assert plan.cost.dtype == jnp.float32
            np.testing.assert_allclose(plan.cost, exact.cost, rtol=1e-3)


# Dynamics that break down beyond a speed, which the plan without the break-down exceeds.


def test_nan_in_parts_of_the_state_space_is_avoided(swing_ups):
    speed = 0.9 * np.abs(swing_ups[0].states[:, 1]).max()

    # The third state, which no residual looks at, is NaN beyond that speed.
    def brittle(x, u):
        return jnp.append(pendulum(x[:2], u), jnp.sqrt(speed**2 - x[1] ** 2))

    start = np.append(STARTS[0], 0.0)
    plan = jax.jit(lambda start: ilqr.solve(pendulum_problem(brittle), start, jnp.asarray(GUESS)))(start)
    assert all(np.isfinite(leaf).all() for leaf in (plan.states, plan.actions, plan.gains, plan.cost))
    assert np.abs(plan.states[:, 1]).max() <= speed
    assert plan.cost < 0.5 * rollout_cost(GUESS, STARTS[0])


def test_nan_that_the_cost_does_not_see_is_avoided():
    # One step, x' = (u, sqrt(1 - u)): the cost alone would take u to 5.
    problem = ilqr.Problem(
        dynamics=lambda x, u: jnp.append(u, jnp.sqrt(1 - u)),
        running_residual=lambda x, u, t: jnp.zeros(1),
        terminal_residual=lambda x: x[:1] - 5.0,
        control_low=jnp.array([-np.inf]),
        control_high=jnp.array([np.inf]),
    )
    plan = jax.jit(lambda start: ilqr.solve(problem, start, jnp.zeros((1, 1))))(np.zeros(2))
    assert np.isfinite(plan.states).all()
    assert 0 < plan.actions[0, 0] <= 1


def test_without_a_finite_rollout_there_is_no_plan():
    broken = pendulum_problem(lambda x, u: pendulum(x, u) * jnp.nan)
    plan = jax.jit(lambda start: ilqr.solve(broken, start, jnp.asarray(GUESS)))(STARTS[0])
    assert plan.cost == np.inf
    assert not plan.converged
    np.testing.assert_array_equal(plan.actions, GUESS)
    np.testing.assert_array_equal(plan.gains, 0)
