"""Planning again while a plan is executed, against loops in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linear_quadratic import cost, lq_problem, random_lq

from milx.trajopt import replanning, sampling
from milx.trajopt.sampling import Options


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.mark.slow
def test_planning_again_costs_less_where_things_turn_out_otherwise():
    """Executes one plan to its end, and replans every second step, under the same disturbances."""
    lq = random_lq(1, T=12, n=3, m=2)
    lq["reference"] = np.concatenate([lq["reference"], np.zeros((12, 3))])
    problem, state = lq_problem(lq, np.inf), jnp.asarray(lq["x_0"])
    options = Options("cross_entropy", samples=64, elites=8, iterations=10, order=0)
    first = sampling.start(jnp.zeros((12, 2)), 1.0)

    def plant(x, u, key):
        return problem.dynamics(x, u) + 0.3 * jax.random.normal(key, x.shape), u

    draws = jax.jit(
        lambda key: replanning.control(
            problem, state, first, 12, 6, 2, key, options, lambda x, u, key: (x + jax.random.normal(key, x.shape), u)
        )
    )
    noise = np.diff(draws(jax.random.key(0))[0], axis=0)
    assert len(np.unique(noise)) == noise.size

    def run(every, key):
        states, actions = replanning.control(problem, state, first, 12, 12, every, key, options, plant)
        running = jax.vmap(problem.running_residual)(states[:-1], actions, jnp.arange(12))
        return 0.5 * jnp.sum(running**2) + 0.5 * jnp.sum(problem.terminal_residual(states[-1]) ** 2)

    keys = jax.random.split(jax.random.key(0), 20)
    once, often = (np.asarray(jax.jit(jax.vmap(lambda key, every=every: run(every, key)))(keys)) for every in (12, 2))
    assert often.mean() + 2 * (often - once).std() / np.sqrt(20) < once.mean()


@pytest.mark.parametrize("order", [0, 1])
def test_a_plan_goes_on_where_the_one_before_stopped(order):
    """Executes a plan that no candidate disturbs; NumPy moves its knots on, and holds the last one."""
    lq = random_lq(0, T=9, n=2, m=1)
    knots, every = np.array([0.0, 0.8, -0.4]), (3, 2)[order]
    search = sampling.start(knots[:, None], 0.0)
    state, key, options = jnp.asarray(lq["x_0"]), jax.random.key(0), Options(samples=1, order=order)
    states, actions = replanning.control(lq_problem(lq, np.inf), state, search, 9, 6, every, key, options)
    at = np.array([0.0, 4.0, 8.0])
    x = lq["x_0"]
    for t in range(6):
        if t and t % every == 0:
            knots = np.interp(at + 2, at, knots) if order else np.append(knots[1:], knots[-1])
        expected = np.interp(t % every, at, knots) if order else knots[0]
        np.testing.assert_allclose(actions[t], [expected], atol=1e-9)
        np.testing.assert_allclose(states[t], x, atol=1e-9)
        x = lq["A"] @ x + lq["B"] @ actions[t]
    np.testing.assert_allclose(states[6], x, atol=1e-9)


def test_the_cheapest_candidate_moves_on_with_the_plan():
    """Both candidates, the mean and the cheapest one, are elites; NumPy averages them and moves them on."""
    lq = random_lq(0, T=9, n=2, m=1)
    at, mean, kept = np.array([0.0, 4.0, 8.0]), np.array([0.0, 0.8, -0.4]), np.array([-0.1, 0.3, 0.2])
    search = sampling.start(mean[:, None], 0.0)._replace(best=jnp.asarray(kept[:, None]))
    options, key = Options("cross_entropy", samples=2, elites=2), jax.random.key(0)
    _, actions = replanning.control(lq_problem(lq, np.inf), jnp.asarray(lq["x_0"]), search, 9, 4, 2, key, options)
    best = min(mean, kept, key=lambda knots: cost(lq, np.interp(np.arange(9), at, knots)[:, None]))
    first = (mean + kept) / 2
    second = (np.interp(at + 2, at, first) + np.interp(at + 2, at, best)) / 2
    expected = np.concatenate([np.interp([0, 1], at, first), np.interp([0, 1], at, second)])
    np.testing.assert_allclose(actions[:, 0], expected, atol=1e-9)


def test_candidates_cost_what_is_left_of_them():
    lq = random_lq(0, T=9, n=3, m=2)
    rng = np.random.default_rng(0)
    knots, x = rng.normal(size=(4, 2)), rng.normal(size=3)
    options = Options(samples=1)
    search = sampling.start(knots, 0.0)
    actions = np.asarray(sampling.actions_of(lq_problem(lq, np.inf), search.knots, 9, options))
    solve = jax.jit(
        lambda now: (
            sampling.solve(lq_problem(lq, np.inf), jnp.asarray(x), search, 9, jax.random.key(0), options, now).cost
        )
    )
    for now in (0, 4, 8, 9):
        np.testing.assert_allclose(solve(now), cost(lq, actions[now:], x, now), rtol=1e-12)


@pytest.mark.parametrize("every", [3, 9])
def test_a_feedback_law_is_told_which_state_the_last_plan_expects(every):
    """Executes a plan that no candidate disturbs, by a plant that jumps; NumPy does the same."""
    lq = random_lq(0, T=9, n=2, m=1)
    knots, jump = np.array([[0.3], [0.8], [-0.4]]), np.array([0.2, -0.1])
    problem, options = lq_problem(lq, np.inf), Options(samples=1)

    def plant(x, u, expected, key):
        return problem.dynamics(2 * expected - x, u) + jump, 3 * u

    states, done = replanning.execute(
        problem, jnp.asarray(lq["x_0"]), sampling.start(knots, 0.0), 9, every, jax.random.key(0), options, plant
    )
    x = expected = lq["x_0"]
    for t, u in enumerate(np.interp(np.arange(9), [0, 4, 8], knots[:, 0])[:, None]):
        if t % every == 0:
            expected = x
        np.testing.assert_allclose(done[t], 3 * u, atol=1e-9)
        np.testing.assert_allclose(states[t], x, atol=1e-9)
        x = lq["A"] @ (2 * expected - x) + lq["B"] @ u + jump
        expected = lq["A"] @ expected + lq["B"] @ u
    np.testing.assert_allclose(states[9], x, atol=1e-9)


def test_what_is_left_is_planned_again_for_less_where_things_turn_out_otherwise():
    """Keeps one plan, or plans again every second step with the cheapest candidate, under random disturbances."""
    lq = random_lq(1, T=12, n=3, m=2)
    problem, state = lq_problem(lq, np.inf), jnp.asarray(lq["x_0"])
    options = Options("predictive", samples=64, iterations=10, order=0)
    plan = sampling.solve(problem, state, sampling.start(jnp.zeros((12, 2)), 0.5), 12, jax.random.key(1), options)

    def plant(x, u, expected, key):
        return problem.dynamics(x, u) + 0.3 * jax.random.normal(key, x.shape), u

    def run(every, key):
        states, actions = replanning.execute(problem, state, plan, 12, every, key, options, plant)
        running = jax.vmap(problem.running_residual)(states[:-1], actions, jnp.arange(12))
        return 0.5 * jnp.sum(running**2) + 0.5 * jnp.sum(problem.terminal_residual(states[-1]) ** 2)

    keys = jax.random.split(jax.random.key(0), 20)
    once, often = (np.asarray(jax.jit(jax.vmap(lambda key, every=every: run(every, key)))(keys)) for every in (12, 2))
    assert often.mean() + 2 * np.hypot(often.std(), once.std()) / np.sqrt(20) < once.mean()


@pytest.mark.parametrize("update", ["predictive", "cross_entropy"])
def test_searches_go_on_around_the_last_plan_with_the_first_deviation(update):
    """A loop solves what is left, with the same keys, by the problem's own dynamics."""
    lq = random_lq(0, T=6, n=2, m=1)
    problem, options = lq_problem(lq, np.inf), Options(update, samples=8, elites=3, iterations=2)
    plan = sampling.start(np.array([[0.3], [0.8], [-0.4]]), 0.5)._replace(best=jnp.array([[0.1], [0.2], [0.3]]))
    states, actions = replanning.execute(problem, jnp.asarray(lq["x_0"]), plan, 6, 2, jax.random.key(3), options)
    x = lq["x_0"]
    for now, key in zip((0, 2, 4), jax.random.split(jax.random.key(3), 3), strict=True):
        if now:
            plan = plan._replace(deviation=jnp.full((3, 1), 0.5))
            plan = sampling.solve(problem, jnp.asarray(x), plan, 6, jax.random.split(key)[0], options, now)
        for t in (now, now + 1):
            u = np.asarray(sampling.actions_of(problem, plan.knots, 6, options))[t]
            np.testing.assert_allclose(actions[t], u, atol=1e-9)
            np.testing.assert_allclose(states[t], x, atol=1e-9)
            x = lq["A"] @ x + lq["B"] @ u
    np.testing.assert_allclose(states[6], x, atol=1e-9)


def test_a_plan_whose_steps_cannot_be_divided_is_refused():
    lq = random_lq(0, T=9, n=2, m=1)
    for every in (0, 4, 18):
        with pytest.raises(ValueError, match=f"every: got {every}, expected a divisor of horizon = 9"):
            replanning.execute(
                lq_problem(lq, 1.0),
                lq["x_0"],
                sampling.start(jnp.zeros((3, 1)), 1.0),
                9,
                every,
                jax.random.key(0),
                Options(),
            )


def test_steps_that_cannot_be_planned_again_are_refused():
    lq = random_lq(0)
    first = sampling.start(jnp.zeros((3, 2)), 1.0)
    for steps, every, order, message in (
        (10, 4, 1, "every: got 4, expected a divisor of steps = 10, at most horizon = 15"),
        (10, 0, 1, "every: got 0, expected a divisor of steps = 10, at most horizon = 15"),
        (10, 2, 0, "every: got 2, expected a multiple of 5 time steps, for which a knot is held"),
    ):
        with pytest.raises(ValueError, match=message):
            replanning.control(
                lq_problem(lq, 1.0), lq["x_0"], first, 15, steps, every, jax.random.key(0), Options(order=order)
            )
