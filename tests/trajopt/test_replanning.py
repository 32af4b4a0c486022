"""Plans that are executed to their end, against loops in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linear_quadratic import lq_problem, random_lq

from milx.trajopt import replanning, sampling
from milx.trajopt.sampling import Options


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


def tail_cost(lq, x, actions, now):
    """Adds up J from step `now` on in a loop."""
    total = 0.0
    for u, reference in zip(actions[now:], lq["reference"][now:], strict=True):
        total += 0.5 * np.sum((lq["S"] @ (x - reference)) ** 2) + 0.5 * np.sum((lq["R"] @ u) ** 2)
        x = lq["A"] @ x + lq["B"] @ u
    return total + 0.5 * np.sum((lq["S_T"] @ x) ** 2)


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
        np.testing.assert_allclose(solve(now), tail_cost(lq, x, actions, now), rtol=1e-12)


@pytest.mark.parametrize("every", [3, 9])
def test_a_feedback_law_is_told_which_state_the_last_plan_expects(every):
    """Executes a plan that no candidate disturbs, by a plant that jumps; NumPy does the same."""
    lq = random_lq(0, T=9, n=2, m=1)
    knots, jump = np.array([[0.3], [0.8], [-0.4]]), np.array([0.2, -0.1])
    problem, options = lq_problem(lq, np.inf), Options(samples=1)

    def plant(x, u, expected, key):
        return problem.dynamics(2 * expected - x, u) + jump

    states, actions = replanning.follow(
        problem, jnp.asarray(lq["x_0"]), sampling.start(knots, 0.0), 9, every, jax.random.key(0), options, plant
    )
    x = expected = lq["x_0"]
    for t, u in enumerate(np.interp(np.arange(9), [0, 4, 8], knots[:, 0])[:, None]):
        if t % every == 0:
            expected = x
        np.testing.assert_allclose(actions[t], u, atol=1e-9)
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
        return problem.dynamics(x, u) + 0.3 * jax.random.normal(key, x.shape)

    def run(every, key):
        states, actions = replanning.follow(problem, state, plan, 12, every, key, options, plant)
        running = jax.vmap(problem.running_residual)(states[:-1], actions, jnp.arange(12))
        return 0.5 * jnp.sum(running**2) + 0.5 * jnp.sum(problem.terminal_residual(states[-1]) ** 2)

    keys = jax.random.split(jax.random.key(0), 20)
    once, often = (np.asarray(jax.jit(jax.vmap(lambda key, every=every: run(every, key)))(keys)) for every in (12, 2))
    assert often.mean() + 2 * np.hypot(often.std(), once.std()) / np.sqrt(20) < once.mean()


def test_a_plan_whose_steps_cannot_be_divided_is_refused():
    lq = random_lq(0, T=9, n=2, m=1)
    for every in (0, 4, 18):
        with pytest.raises(ValueError, match=f"every: got {every}, expected a divisor of horizon = 9"):
            replanning.follow(
                lq_problem(lq, 1.0),
                lq["x_0"],
                sampling.start(jnp.zeros((3, 1)), 1.0),
                9,
                every,
                jax.random.key(0),
                Options(),
            )
