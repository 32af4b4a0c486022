"""Sampling-based planning against a Riccati recursion, SciPy, and its own laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate
from linear_quadratic import bounded_least_squares, lq_problem, random_lq, riccati

from milx.trajopt import sampling
from milx.trajopt.sampling import Options


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


def cost(lq, actions):
    """Adds up J in a loop."""
    x, total = lq["x_0"], 0.0
    for u, reference in zip(actions, lq["reference"], strict=True):
        total += 0.5 * np.sum((lq["S"] @ (x - reference)) ** 2) + 0.5 * np.sum((lq["R"] @ u) ** 2)
        x = lq["A"] @ x + lq["B"] @ u
    return total + 0.5 * np.sum((lq["S_T"] @ x) ** 2)


def plan(lq, options, limit=np.inf, deviation=1.0, seed=0):
    """Searches with a knot for every time step, from zero."""
    T, m = lq["guess"].shape
    problem, first = lq_problem(lq, limit), sampling.start(jnp.zeros((T, m)), deviation)
    search = jax.jit(lambda key: sampling.solve(problem, jnp.asarray(lq["x_0"]), first, T, key, options))
    found = search(jax.random.key(seed))
    return found, np.asarray(sampling.actions_of(problem, found.knots, T, options))


@pytest.mark.parametrize("order", sampling.ORDERS)
def test_splines_are_those_of_scipy(order):
    knots = np.random.default_rng(0).normal(size=(5, 2))
    at, when = np.linspace(0, 16, 5), np.array([0.0, 0.5, 3.9, 4.0, 11.2, 16.0, 25.0])
    expected = {
        0: scipy.interpolate.interp1d(at, knots, kind="previous", axis=0),
        1: scipy.interpolate.make_interp_spline(at, knots, k=1),
        3: scipy.interpolate.make_interp_spline(at, knots, k=3, bc_type="natural"),
    }[order](np.minimum(when, 16))
    np.testing.assert_allclose(sampling.basis(order, when, 17, 5) @ knots, expected, atol=1e-12)
    np.testing.assert_array_equal(sampling.basis(order, when, 17, 1), np.ones((7, 1)))


@pytest.mark.parametrize("update", ["cross_entropy", "mppi"])
@pytest.mark.parametrize("seed", [0, 1])
def test_the_cost_of_a_linear_problem_is_riccatis(update, seed):
    lq = random_lq(seed, T=6, n=3, m=1)
    settings = {
        "cross_entropy": {"samples": 256, "elites": 32, "iterations": 60},
        "mppi": {"samples": 1024, "iterations": 200, "temperature": 0.05},
    }[update]
    best = cost(lq, riccati(lq)[1])
    first = cost(lq, np.zeros((6, 1)))
    found, actions = plan(lq, Options(update, order=0, **settings), deviation=1.0 if update == "cross_entropy" else 0.1)
    assert first > 1.2 * best
    assert best * (1 - 1e-9) <= cost(lq, actions) < best + 1e-2 * (first - best)
    np.testing.assert_allclose(found.cost, cost(lq, actions), rtol=0.02)


def test_limits_are_kept_and_their_best_cost_is_reached():
    lq = random_lq(3, T=6, n=3, m=1)
    limit = 0.3
    best, first = bounded_least_squares(lq, limit)[1], cost(lq, np.zeros((6, 1)))
    options = Options("cross_entropy", samples=256, elites=32, iterations=60, order=0, deviation_min=0.02)
    _, actions = plan(lq, options, limit)
    assert np.abs(actions).max() <= limit + 1e-12
    assert best * (1 - 1e-6) <= cost(lq, actions) < best + 1e-2 * (first - best)


def test_more_samples_cost_less_and_no_iteration_of_predictive_sampling_costs_more():
    lq = random_lq(2, T=8, n=3, m=2)
    means = []
    for samples in (2, 16, 128):
        costs = [
            plan(lq, Options(samples=samples, iterations=5), deviation=0.3, seed=seed)[0].cost for seed in range(8)
        ]
        means.append(np.mean(costs))
    assert means[0] > means[1] > means[2]
    problem, state = lq_problem(lq, np.inf), jnp.asarray(lq["x_0"])
    search = sampling.start(jnp.zeros((8, 2)), 0.3)
    for key in jax.random.split(jax.random.key(1), 20):
        after = sampling.solve(problem, state, search, 8, key, Options(samples=8))
        np.testing.assert_allclose(after.cost, cost(lq, np.asarray(after.knots)), rtol=1e-9)
        assert after.cost <= search.cost
        search = after


@pytest.mark.parametrize("update", sampling.UPDATES)
def test_a_batch_is_a_loop(update):
    lq = random_lq(4, T=7, n=3, m=2)
    options = Options(update, samples=16, iterations=3, order=3, elites=4)
    problem, search = lq_problem(lq, 1.0), sampling.start(jnp.zeros((4, 2)), 0.5)
    states, keys = jnp.stack([lq["x_0"], -lq["x_0"], 2 * lq["x_0"]]), jax.random.split(jax.random.key(0), 3)
    solve = lambda state, key: sampling.solve(problem, state, search, 7, key, options)  # noqa: E731
    together = jax.vmap(solve)(states, keys)
    for i in range(3):
        jax.tree.map(
            lambda x, y, i=i: np.testing.assert_allclose(x[i], y, atol=1e-9), together, solve(states[i], keys[i])
        )


@pytest.mark.parametrize("update", sampling.UPDATES)
def test_candidates_that_diverge_count_for_nothing(update):
    """Compares with the same problem in which their cost is so high that they do not count, and lets all diverge."""
    lq = random_lq(5, T=5, n=2, m=1)
    problem = lq_problem(lq, np.inf)

    def edged(value):
        residual = lambda x, u, t: problem.running_residual(x, u, t) + jnp.where(u[0] > 0.2, value, 0.0)  # noqa: E731
        return problem._replace(running_residual=residual)

    options = Options(update, samples=64, elites=4, order=0)
    first, state, key = sampling.start(jnp.zeros((5, 1)), 0.2), jnp.asarray(lq["x_0"]), jax.random.key(0)
    found, expected = (sampling.solve(edged(x), state, first, 5, key, options) for x in (np.nan, 1e8))
    np.testing.assert_allclose(found.knots, expected.knots, atol=1e-12)
    lost = sampling.solve(edged(0.0)._replace(dynamics=lambda x, u: x * np.nan), state, first, 5, key, options)
    np.testing.assert_array_equal(lost.knots, first.knots)
    assert lost.cost == np.inf


def test_planning_again_costs_less_where_things_turn_out_otherwise():
    """Executes one plan to its end, and replans every second step, under the same disturbances."""
    lq = random_lq(1, T=12, n=3, m=2)
    lq["reference"][:] = 0.0
    problem, state = lq_problem(lq, np.inf), jnp.asarray(lq["x_0"])
    options = Options("cross_entropy", samples=64, elites=8, iterations=10, order=0)
    first = sampling.start(jnp.zeros((12, 2)), 1.0)

    def plant(x, u, key):
        return problem.dynamics(x, u) + 0.3 * jax.random.normal(key, x.shape)

    def run(every, key):
        states, actions = sampling.control(problem, state, first, 12, 12, every, key, options, plant)
        running = jax.vmap(lambda x, u: problem.running_residual(x, u, 0))(states[:-1], actions)
        return 0.5 * jnp.sum(running**2) + 0.5 * jnp.sum(problem.terminal_residual(states[-1]) ** 2)

    keys = jax.random.split(jax.random.key(0), 20)
    once, often = (np.asarray(jax.jit(jax.vmap(lambda key, every=every: run(every, key)))(keys)) for every in (12, 2))
    assert often.mean() + 2 * (often - once).std() / np.sqrt(20) < once.mean()


def test_a_plan_goes_on_where_the_one_before_stopped():
    """Executes a plan that no candidate disturbs; NumPy moves its knots on, and holds the last one."""
    lq = random_lq(0, T=9, n=2, m=1)
    knots, at = np.array([0.0, 0.8, -0.4]), np.array([0.0, 4.0, 8.0])
    search = sampling.start(knots[:, None], 0.0)
    state, key = jnp.asarray(lq["x_0"]), jax.random.key(0)
    states, actions = sampling.control(lq_problem(lq, np.inf), state, search, 9, 8, 2, key, Options(samples=1))
    x = lq["x_0"]
    for t in range(8):
        if t and t % 2 == 0:
            knots = np.interp(at + 2, at, knots)
        np.testing.assert_allclose(actions[t], [np.interp(t % 2, at, knots)], atol=1e-9)
        np.testing.assert_allclose(states[t], x, atol=1e-9)
        x = lq["A"] @ x + lq["B"] @ actions[t]
    np.testing.assert_allclose(states[8], x, atol=1e-9)


def test_settings_that_make_no_sense_are_refused():
    for settings, message in (
        ({"update": "best"}, "update: got 'best', expected one of predictive, cross_entropy, mppi"),
        ({"order": 2}, "order: got 2, expected one of 0, 1, 3"),
        ({"update": "cross_entropy", "samples": 4}, "elites: got 8, expected 2 to samples = 4"),
    ):
        with pytest.raises(ValueError, match=message):
            Options(**settings)
    with pytest.raises(ValueError, match="knots: got 9, expected 1 to 8, the time steps"):
        sampling.basis(0, np.arange(8), 8, 9)
    lq = random_lq(0)
    with pytest.raises(ValueError, match="every: got 4, expected a divisor of steps = 10, at most horizon = 15"):
        first = sampling.start(jnp.zeros((3, 2)), 1.0)
        sampling.control(lq_problem(lq, 1.0), lq["x_0"], first, 15, 10, 4, jax.random.key(0), Options())
