"""Demonstrations with a receding horizon on a cart, whose world is a few lines."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.trajopt import receding, replanning, sampling
from milx.trajopt.episode import approximated, steered
from milx.trajopt.receding import Settings
from milx.trajopt.sampling import Options

NOISE = 0.05
SETTINGS = Settings(search=Options("cross_entropy", samples=16, iterations=2, elites=4, order=1))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"every": 0}, "every: got 0, expected at least 1"),
        ({"knots": 0}, "knots: got 0, expected at least 1"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SETTINGS, **changes)


def test_an_environment_that_looks_nowhere_is_refused(cart, scenes, monkeypatch):
    monkeypatch.setattr(type(cart), "ahead", 0)
    with pytest.raises(ValueError, match="ahead of cart: got 0, expected at least 1"):
        receding.demonstrate(cart, dataclasses.replace(SETTINGS, every=3), 0.0, *scenes)


def test_demonstrations_succeed_where_standing_still_does_not(cart, scenes):
    task, start, keys = scenes
    states, _ = receding.demonstrate(cart, SETTINGS, NOISE, task, start, keys)
    assert jax.vmap(cart.success)(task, states).mean() > 0.95
    still = jax.tree.map(lambda x: jnp.repeat(x[:, None], 13, axis=1), start)
    assert jax.vmap(cart.success)(task, still).mean() < 0.5


def test_what_is_executed_is_what_was_recorded_and_noise(cart, scenes):
    """Infers what drove the cart from its velocities: without noise the action, and otherwise what spreads so."""
    task, start, keys = scenes
    for noise in (0.0, NOISE):
        states, actions = receding.demonstrate(cart, SETTINGS, noise, task, start, keys)
        driven = np.diff(states.qvel[..., 0], axis=1) / 0.25
        off = (driven - actions[..., 0])[np.abs(driven) < 0.99]
        assert off.size > 300
        # Three standard errors of a standard deviation.
        np.testing.assert_allclose(np.sqrt((off**2).mean()), noise, rtol=3 / np.sqrt(2 * off.size), atol=1e-5)


def test_plans_are_made_in_the_approximation_and_executed_in_the_world(cart, scenes):
    """A loop searches in the lighter cart's dynamics, with the same keys, and drives the heavier one."""
    task, start = scenes[0][0], jax.tree.map(lambda x: x[0], scenes[1])
    states, actions = receding.demonstrate(
        cart, dataclasses.replace(SETTINGS, every=8), 0.0, *jax.tree.map(lambda x: x[None], (task, start, scenes[2][0]))
    )
    problem = approximated(steered(cart, task, start))
    state, search = start, sampling.start(jnp.zeros((4, 1)), 0.5)
    for now, key in zip((0, 6), jax.random.split(scenes[2][0], 2), strict=True):
        found = sampling.solve(problem, state.vector, search, 8, jax.random.split(key)[0], SETTINGS.search)
        controls = np.interp(np.arange(8), np.linspace(0, 7, 4), found.knots[:, 0])
        for t in range(6):
            action = np.clip(controls[t], -2, 2) / 2
            np.testing.assert_allclose(actions[0, now + t, 0], action, atol=1e-5)
            state = cart.step(task, state, jnp.array([action]))
            np.testing.assert_allclose(states.qpos[0, now + t + 1], state.qpos, atol=1e-5)
        at = np.linspace(0, 7, 4)
        moved = lambda knots: np.interp(np.clip(at + 6, 0, 7), at, knots[:, 0])[:, None]  # noqa: B023, E731
        search = sampling.start(moved(found.knots), 0.5)._replace(best=jnp.asarray(moved(found.best)))


def test_scenes_do_not_depend_on_those_beside_them(cart, scenes):
    task, start, keys = scenes
    few = lambda tree: jax.tree.map(lambda x: x[:8], tree)  # noqa: E731
    states, actions = receding.demonstrate(cart, SETTINGS, NOISE, task, start, keys)
    alone, of_them = receding.demonstrate(cart, SETTINGS, NOISE, few(task), few(start), keys[:8])
    np.testing.assert_allclose(of_them, actions[:8], atol=1e-4)
    np.testing.assert_allclose(alone.qpos, states.qpos[:8], atol=1e-4)


def test_a_short_episode_is_planned_to_its_end_at_divisors_of_its_steps(cart, scenes, monkeypatch):
    asked = []

    def note(problem, state, search, ahead, steps, every, *rest):
        asked.append((ahead, steps, every, len(search.knots)))
        return replanning.control(problem, state, search, ahead, steps, every, *rest)

    monkeypatch.setattr(receding, "replanning", types.SimpleNamespace(control=note))
    for ahead, every, knots, expected in (
        (8, 1, 4, (8, 12, 1, 4)),
        (8, 5, 4, (8, 12, 4, 4)),
        (8, 50, 4, (8, 12, 6, 4)),
        (50, 50, 20, (12, 12, 12, 12)),
    ):
        monkeypatch.setattr(type(cart), "ahead", ahead)
        chosen = dataclasses.replace(SETTINGS, every=every, knots=knots)
        jax.eval_shape(lambda *scene, chosen=chosen: receding.demonstrate(cart, chosen, 0.0, *scene), *scenes)
        assert asked.pop() == expected
