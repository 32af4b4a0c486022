"""Demonstrations with a receding horizon on a cart, whose world is a few lines."""

import dataclasses
import functools
import types

import cart_laws
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


def test_a_plan_without_a_knot_is_refused():
    with pytest.raises(ValueError, match="knots: got 0, expected at least 1"):
        dataclasses.replace(SETTINGS, knots=0)


def test_an_environment_that_looks_nowhere_is_refused(cart, scenes, monkeypatch):
    monkeypatch.setattr(type(cart), "ahead", 0)
    with pytest.raises(ValueError, match="ahead of cart: got 0, expected at least 1"):
        receding.demonstrate(cart, SETTINGS, 0.0, *scenes)


def test_demonstrations_succeed_where_standing_still_does_not(cart, scenes):
    task, start, keys = scenes
    states, _ = receding.demonstrate(cart, SETTINGS, NOISE, task, start, keys)
    assert jax.vmap(cart.success)(task, states).mean() > 0.95
    still = jax.tree.map(lambda x: jnp.repeat(x[:, None], 13, axis=1), start)
    assert jax.vmap(cart.success)(task, still).mean() < 0.5


def test_what_is_executed_is_what_was_recorded_and_noise(cart, scenes):
    demonstrate = functools.partial(receding.demonstrate, cart, SETTINGS)
    cart_laws.check_that_noise_alone_is_not_recorded(demonstrate, scenes, NOISE)


@pytest.mark.slow
def test_plans_are_made_in_the_approximation_and_executed_in_the_world(cart, scenes):
    """A loop searches in the lighter cart's dynamics, with the candidates of all scenes, and drives the heavier one."""
    task, start = scenes[0][0], jax.tree.map(lambda x: x[0], scenes[1])
    alone = jax.tree.map(lambda x: x[None], (task, start, scenes[2][0]))
    states, actions = receding.demonstrate(cart, SETTINGS, 0.0, *alone)
    problem = approximated(steered(cart, task, start))
    state, search = start, sampling.start(jnp.zeros((4, 1)), 0.5)
    at = np.linspace(0, 7, 4)
    moved = lambda knots: np.interp(np.clip(at + 1, 0, 7), at, knots[:, 0])[:, None]  # noqa: E731
    for now, key in enumerate(jax.random.split(jax.random.key(0), 12)):
        found = sampling.solve(problem, state.vector, search, 8, jax.random.split(key)[0], SETTINGS.search)
        action = np.clip(found.knots[0], -2, 2) / 2
        np.testing.assert_allclose(actions[0, now], action, atol=1e-5)
        state = cart.step(task, state, action)
        np.testing.assert_allclose(states.qpos[0, now + 1], state.qpos, atol=1e-5)
        search = sampling.start(moved(found.knots), 0.5)._replace(best=jnp.asarray(moved(found.best)))


def test_only_noise_tells_two_demonstrations_of_a_scene_apart(cart, scenes):
    demonstrate = functools.partial(receding.demonstrate, cart, SETTINGS)
    cart_laws.check_that_noise_alone_tells_demonstrations_of_a_scene_apart(demonstrate, scenes, NOISE)


def test_scenes_do_not_depend_on_those_beside_them(cart, scenes):
    task, start, keys = scenes
    few = lambda tree: jax.tree.map(lambda x: x[:8], tree)  # noqa: E731
    states, actions = receding.demonstrate(cart, SETTINGS, NOISE, task, start, keys)
    alone, of_them = receding.demonstrate(cart, SETTINGS, NOISE, few(task), few(start), keys[:8])
    np.testing.assert_allclose(of_them, actions[:8], atol=1e-4)
    np.testing.assert_allclose(alone.qpos, states.qpos[:8], atol=1e-4)


def test_an_episode_is_planned_anew_at_every_step_and_no_farther_than_it_is_long(cart, scenes, monkeypatch):
    asked = []

    def note(problem, state, search, ahead, steps, every, *rest):
        asked.append((ahead, steps, every, len(search.knots)))
        return replanning.control(problem, state, search, ahead, steps, every, *rest)

    monkeypatch.setattr(receding, "replanning", types.SimpleNamespace(control=note))
    for ahead, knots, expected in ((8, 3, (8, 12, 1, 3)), (8, 20, (8, 12, 1, 8)), (50, 21, (12, 12, 1, 12))):
        monkeypatch.setattr(type(cart), "ahead", ahead)
        chosen = dataclasses.replace(SETTINGS, knots=knots)
        jax.eval_shape(lambda *scene, chosen=chosen: receding.demonstrate(cart, chosen, 0.0, *scene), *scenes)
        assert asked.pop() == expected
