"""Sampling-based planning against a Riccati recursion, SciPy, and its own laws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate
from linear_quadratic import bounded_least_squares, cost, lq_problem, random_lq, riccati

from milx.trajopt import sampling
from milx.trajopt.sampling import Options


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


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
    at, when = np.linspace(0, 16, 5), np.array([0.0, 0.5, 3.3, 3.5, 11.2, 16.0, 25.0])
    expected = {
        0: scipy.interpolate.interp1d([*np.arange(5) * 17 / 5, 17], [*knots, knots[-1]], kind="previous", axis=0),
        1: scipy.interpolate.make_interp_spline(at, knots, k=1),
        3: scipy.interpolate.make_interp_spline(at, knots, k=3, bc_type="natural"),
    }[order](np.minimum(when, 16))
    np.testing.assert_allclose(sampling.basis(order, when, 17, 5) @ knots, expected, atol=1e-12)
    np.testing.assert_array_equal(sampling.basis(order, when, 17, 1), np.ones((7, 1)))


def test_knots_are_held_for_the_time_steps_that_whole_numbers_say():
    for horizon in range(1, 60):
        for knots in range(1, horizon + 1):
            expected = [step * knots // horizon for step in range(horizon)]
            rows = sampling.basis(0, np.arange(horizon), horizon, knots)
            np.testing.assert_array_equal(rows, np.eye(knots)[expected])


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


def test_more_samples_cost_less():
    lq = random_lq(2, T=8, n=3, m=2)
    problem, state, first = lq_problem(lq, np.inf), jnp.asarray(lq["x_0"]), sampling.start(jnp.zeros((8, 2)), 0.3)
    means = []
    for samples in (2, 16, 128):
        options = Options(samples=samples, iterations=5)
        solve = jax.vmap(lambda key, options=options: sampling.solve(problem, state, first, 8, key, options).cost)
        means.append(jax.jit(solve)(jax.random.split(jax.random.key(0), 8)).mean())
    assert means[0] > means[1] > means[2]


@pytest.mark.parametrize("update", sampling.UPDATES)
def test_the_cheapest_candidate_is_kept(update):
    lq = random_lq(2, T=8, n=3, m=2)
    problem, state, search = lq_problem(lq, np.inf), jnp.asarray(lq["x_0"]), sampling.start(jnp.zeros((8, 2)), 0.3)
    options = Options(update, samples=8, elites=4)
    step = jax.jit(lambda search, key: sampling.solve(problem, state, search, 8, key, options))
    for key in jax.random.split(jax.random.key(1), 20):
        after = step(search, key)
        np.testing.assert_allclose(after.cost, cost(lq, np.asarray(after.best)), rtol=1e-9)
        if update == "predictive":
            np.testing.assert_array_equal(after.knots, after.best)
        assert after.cost <= search.cost
        search = after


def test_a_search_begins_with_the_cheapest_of_several_plans():
    lq = random_lq(2, T=8, n=3, m=2)
    problem, state = lq_problem(lq, 0.5), jnp.asarray(lq["x_0"])
    plans = jax.random.normal(jax.random.key(0), (5, 8, 2))
    found = sampling.start_from(problem, state, plans, 0.3, 8, Options())
    costs = [cost(lq, np.clip(plan, -0.5, 0.5)) for plan in plans]
    np.testing.assert_allclose(found.cost, min(costs), rtol=1e-9)
    np.testing.assert_allclose(found.knots, np.clip(plans[np.argmin(costs)], -0.5, 0.5))


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
@pytest.mark.parametrize("edge", [0.2, -0.35])
def test_candidates_that_diverge_count_for_nothing(update, edge):
    """Compares with the same problem in which their cost is so high that they do not count; few or many are lost."""
    lq = random_lq(5, T=3, n=2, m=1)
    problem = lq_problem(lq, np.inf)

    def edged(value):
        residual = lambda x, u, t: problem.running_residual(x, u, t) + jnp.where(u[0] > edge, value, 0.0)  # noqa: E731
        return problem._replace(running_residual=residual)

    options = Options(update, samples=64, elites=2 if edge < 0 else 8, order=0)
    first, state, key = sampling.start(jnp.full((3, 1), edge), 0.2), jnp.asarray(lq["x_0"]), jax.random.key(0)
    found, expected = (sampling.solve(edged(x), state, first, 3, key, options) for x in (np.nan, 1e8))
    np.testing.assert_allclose(found.knots, expected.knots, atol=1e-12)
    np.testing.assert_allclose(found.deviation, expected.deviation, atol=1e-12)


@pytest.mark.parametrize("update", sampling.UPDATES)
def test_where_all_diverge_the_search_stays(update):
    """Loses the second of three states, which the dynamics make finite again, and the costs do not see."""
    problem = sampling.Problem(
        dynamics=lambda x, u: jnp.stack([u[0], x[1] + jnp.where(jnp.isfinite(x[0]), 1.0, 0.0)]),
        running_residual=lambda x, u, t: u,
        terminal_residual=lambda x: x[:1],
        control_low=jnp.full(1, -np.inf),
        control_high=jnp.full(1, np.inf),
    )
    options, first = Options(update, samples=8, elites=4, order=0), sampling.start(jnp.zeros((2, 1)), 1.0)
    state, key = jnp.zeros(2), jax.random.key(0)
    assert np.isfinite(sampling.solve(problem, state, first, 2, key, options).cost)
    once = lambda x, u: jnp.where(x[1] == 0, jnp.array([np.nan, 1.0]), problem.dynamics(jnp.nan_to_num(x), u))  # noqa: E731
    lost = sampling.solve(problem._replace(dynamics=once), state, first, 2, key, options)
    np.testing.assert_array_equal(lost.knots, first.knots)
    np.testing.assert_array_equal(lost.best, first.knots)
    np.testing.assert_array_equal(lost.deviation, first.deviation)
    assert lost.cost == np.inf
    plans = jax.random.normal(key, (3, 2, 1))
    begun = sampling.start_from(problem._replace(dynamics=once), state, plans, 1.0, 2, options)
    np.testing.assert_array_equal(begun.knots, plans[0])
    assert begun.cost == np.inf


def test_one_elite_that_is_left_does_not_end_the_search():
    """Loses all candidates but the mean: where their deviation stayed zero, the search would never move again."""
    problem = lq_problem(random_lq(5, T=3, n=2, m=1), np.inf)
    only = lambda x, u, t: problem.running_residual(x, u, t) + jnp.where(u[0] == 0, 0.0, np.nan)  # noqa: E731
    options, first = Options("cross_entropy", samples=16, elites=4, order=0), sampling.start(jnp.zeros((3, 1)), 0.5)
    state = jnp.ones(2)
    found = sampling.solve(problem._replace(running_residual=only), state, first, 3, jax.random.key(0), options)
    np.testing.assert_array_equal(found.deviation, first.deviation)
    assert np.isfinite(found.cost)


def test_float32_finds_nearly_what_float64_does():
    lq = random_lq(1, T=6, n=3, m=1)
    options = Options("cross_entropy", samples=256, elites=32, iterations=60, order=0)
    first = sampling.start(jnp.zeros((6, 1)), 1.0)
    with jax.enable_x64(False):
        small = {name: value.astype(np.float32) for name, value in lq.items()}
        state = jnp.asarray(small["x_0"])
        found = sampling.solve(lq_problem(small, np.inf), state, first, 6, jax.random.key(0), options)
        assert found.knots.dtype == jnp.float32
    best = cost(lq, riccati(lq)[1])
    assert cost(lq, np.asarray(found.knots, np.float64)) < best + 1e-2 * (cost(lq, np.zeros((6, 1))) - best)


def test_settings_that_make_no_sense_are_refused():
    for settings, message in (
        ({"update": "best"}, "update: got 'best', expected one of predictive, cross_entropy, mppi"),
        ({"order": 2}, "order: got 2, expected one of 0, 1, 3"),
        ({"update": "cross_entropy", "samples": 4}, "elites: got 8, expected 2 to samples = 4"),
        ({"samples": 0}, "samples: got 0, expected at least 1"),
        ({"temperature": 0.0}, r"temperature: got 0\.0, expected more than 0"),
        ({"deviation_min": -1.0}, r"deviation_min: got -1\.0, expected at least 0"),
    ):
        with pytest.raises(ValueError, match=message):
            Options(**settings)
    with pytest.raises(ValueError, match="knots: got 9, expected 1 to 8, the time steps"):
        sampling.basis(0, np.arange(8), 8, 9)
