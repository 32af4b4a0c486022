"""Experts that learn by policy optimization: on a cart, whose world is a few lines, and what push has them suppose."""

import dataclasses
import functools

import cart_laws
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import milx
from milx.envs.base import State
from milx.envs.shapes import SHAPES
from milx.envs.shapes.primitives import distance_to_outline, to_geoms
from milx.networks.mlp import MLP
from milx.trajopt import learned, ppo
from milx.trajopt.expert import Learned
from milx.trajopt.learned import Settings

NOISE = 0.05
SETTINGS = Settings(iterations=80, episodes=64, width=32, options=ppo.Options(minibatches=4, rate=3e-3))


@pytest.fixture(scope="module")
def found(cart):
    return learned.learn(cart, SETTINGS, NOISE, jax.random.key(0))


def test_settings_out_of_range_are_refused():
    with pytest.raises(ValueError, match="episodes: got 0, expected at least 1"):
        Settings(episodes=0)
    with pytest.raises(ValueError, match=r"astray: got -0\.1, expected at least 0"):
        Settings(astray=-0.1)
    with pytest.raises(ValueError, match=r"least: got 0\.6, expected more than 0 and at most deviation = 0\.5"):
        Settings(least=0.6)


def test_minibatches_of_different_sizes_are_refused(cart):
    settings = Settings(episodes=3, options=ppo.Options(minibatches=5))
    with pytest.raises(ValueError, match=r"options\.minibatches: got 5, expected a divisor of 36, all time steps"):
        learned.learn(cart, settings, NOISE, jax.random.key(0))


def total(cart, task, start, actions):
    """Adds up the planners' costs, in the approximation and without noise."""
    cost, state = 0.0, start
    for t, action in enumerate(actions):
        cost += jnp.square(cart.running_residual(task, state, action, t)).sum() / 2
        state = cart.approximate_step(task, state, action)
    return cost + jnp.square(cart.terminal_residual(task, state)).sum() / 2


def test_it_costs_little_more_than_the_best_actions(cart, scenes, found):
    """SciPy finds these with all that is to come in view; the cost is convex."""
    actor, _ = found
    act = jax.jit(functools.partial(learned.act, cart, SETTINGS, actor))
    value = jax.jit(jax.value_and_grad(lambda actions, task, start: total(cart, task, start, actions[:, None])))
    costs = []
    for i in range(20):
        task, start = jax.tree.map(lambda x, i=i: x[i], scenes[:2])
        state, actions = start, []
        for _ in range(cart.horizon):
            actions.append(jnp.clip(act(task, state), -1, 1))
            state = cart.approximate_step(task, state, actions[-1])
        best = scipy.optimize.minimize(
            lambda x, task=task, start=start: [np.asarray(v, float) for v in value(jnp.asarray(x, float), task, start)],
            np.zeros(cart.horizon),
            jac=True,
            bounds=[(-1, 1)] * cart.horizon,
        )
        nothing = total(cart, task, start, jnp.zeros((cart.horizon, 1)))
        costs.append([float(total(cart, task, start, actions)), best.fun, float(nothing)])
    acted, best, nothing = np.mean(costs, axis=0)
    assert best <= acted < best + 0.1 * (nothing - best)


def test_episodes_cost_less_and_less(found):
    _, costs = found
    assert costs[-10:].mean() < 0.1 * costs[0]


def test_an_episode_is_what_its_controls_and_the_noise_make_of_it(cart, found):
    """What is supposed is off by a constant, the rewards are minus the costs, and the critic sees the truth."""
    moments = learned.Moments(jnp.ones(()), jnp.zeros(12), 1 + jnp.zeros(12))
    params = {"policy": found[0].params, "deviation": jnp.log(jnp.full(1, 0.3))}
    params["critic"] = MLP(1, SETTINGS.width).init(jax.random.key(0), jnp.zeros(12))
    run = jax.jit(functools.partial(learned._episode, cart, SETTINGS, NOISE, moments, params))
    drawn, errors = [], []
    for key in jax.random.split(jax.random.key(3), 60):
        seen, control, reward = map(np.asarray, run(key))
        supposed, truth, velocity, time = seen[:, :5], seen[:, 5:10], seen[:, 10], seen[:, 11]
        errors.append(supposed[0, 0] - truth[0, 0])
        np.testing.assert_allclose(
            supposed - truth, np.tile(errors[-1] * np.array([1, 0, 1, 1, 0]), (12, 1)), atol=1e-5
        )
        np.testing.assert_allclose(truth[:, 1], velocity)
        np.testing.assert_allclose(time, np.arange(12) / 12, rtol=1e-6)
        np.testing.assert_allclose(np.diff(truth[:, 0]), 0.25 * velocity[1:], atol=1e-5)
        action = np.clip(control[:, 0], -1, 1)
        expected = -(truth[:, 3] ** 2 + (0.1 * action) ** 2) / 2
        np.testing.assert_allclose(reward[:-1], expected[:-1], rtol=1e-4, atol=1e-6)
        assert reward[-1] < expected[-1], "the terminal cost"
        driven = np.diff(velocity) / 0.25 * 0.8
        drawn.append(np.where(np.abs(driven) < 0.99, driven - action[:-1], np.nan))
    count = np.isfinite(drawn).sum()
    assert count > 200
    np.testing.assert_allclose(np.sqrt(np.nanmean(np.square(drawn))), NOISE, rtol=3 / np.sqrt(2 * count))
    np.testing.assert_allclose(np.std(errors), 0.02, rtol=3 / np.sqrt(2 * 60))


def test_half_of_the_episodes_begin_where_the_policy_has_gone_astray(cart, found, monkeypatch):
    """All carts begin at their goals, where a policy that sees them as they are lets them stay."""
    params = {"policy": found[0].params, "deviation": jnp.log(jnp.full(1, 0.001))}
    params["critic"] = MLP(1, SETTINGS.width).init(jax.random.key(0), jnp.zeros(12))
    monkeypatch.setattr(cart, "sample_task", lambda key, split: jnp.zeros(1))
    monkeypatch.setattr(cart, "reset", lambda key, task: State(jnp.zeros(1), jnp.zeros(1), jnp.zeros((0, 3))))
    settings, keys = dataclasses.replace(SETTINGS, least=0.001), jax.random.split(jax.random.key(4), 400)

    def begin(settings, far):
        """Returns how far from their goals the carts begin [400]."""
        monkeypatch.setattr(learned, "_FAR", far)
        run = functools.partial(learned._episode, cart, settings, NOISE, found[0].moments, params)
        return np.abs(jax.jit(jax.vmap(run))(keys)[0][:, 0, 5])

    astray, right = begin(settings, 5.0), begin(settings, 0.0)
    assert not begin(dataclasses.replace(settings, astray=0.0), 5.0).any()
    most = round(settings.astray * cart.horizon)
    share = most / (2 * most + 1)
    assert abs((astray > 0).mean() - share) < 3 * np.sqrt(share * (1 - share) / 400)
    assert astray.mean() > 5 * right.mean()
    assert 0.01 < astray[astray > 0].mean() < 0.1, "five times 0.02 is as far as it would go"


def test_episodes_that_diverge_do_not_count(cart, monkeypatch):
    """A third of the carts begin nowhere, and in the end all of them do."""
    reset, odd = cart.reset, type(cart)()

    def nowhere(share, key, task):
        state = reset(key, task)
        return dataclasses.replace(state, qpos=jnp.where(jax.random.uniform(key) < share, jnp.nan, state.qpos))

    monkeypatch.setattr(odd, "reset", functools.partial(nowhere, 1 / 3), raising=False)
    settings = dataclasses.replace(SETTINGS, iterations=30)
    actor, costs = learned.learn(odd, settings, NOISE, jax.random.key(0))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(actor))
    assert costs[-5:].mean() < 0.2 * costs[0]
    monkeypatch.setattr(odd, "reset", functools.partial(nowhere, 1.0))
    with pytest.raises(FloatingPointError, match="cart: got a cost of nan, expected a finite one"):
        learned.learn(odd, dataclasses.replace(settings, width=16), NOISE, jax.random.key(0))


def test_demonstrations_record_all_but_the_noise(cart, scenes, found):
    expert = Learned(SETTINGS, found[0])

    def demonstrate(noise, task, start, keys):
        return expert.perform(cart, task, start, keys, noise)

    cart_laws.check_that_noise_alone_is_not_recorded(demonstrate, scenes, NOISE)
    cart_laws.check_that_noise_alone_tells_demonstrations_of_a_scene_apart(demonstrate, scenes, NOISE)


def test_the_same_is_learned_again_and_its_shapes_are_known(cart, found):
    again, _ = learned.learn(cart, SETTINGS, NOISE, jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, again, found[0])
    expected = learned.shapes(cart, SETTINGS)
    assert jax.tree.structure(expected) == jax.tree.structure(found[0])
    assert [x.shape for x in jax.tree.leaves(expected)] == [x.shape for x in jax.tree.leaves(found[0])]


def test_moments_are_those_of_all_that_was_seen():
    seen = np.random.default_rng(0).normal(3.0, 2.0, (4, 5, 6, 3))
    moments = learned.Moments(jnp.zeros(()), jnp.zeros(3), jnp.zeros(3))
    for part in seen:
        moments = moments.add(jnp.asarray(part, float))
    mean, deviation = seen.mean(axis=(0, 1, 2)), seen.std(axis=(0, 1, 2))
    np.testing.assert_allclose(moments.whiten(jnp.asarray(mean + 2 * deviation, float)), 2.0, rtol=1e-4)
    np.testing.assert_allclose(moments.whiten(jnp.asarray((mean - deviation)[:2], float)), -1.0, rtol=1e-4)


@pytest.fixture(scope="module")
def push():
    return milx.make("push", (8, 8))


def test_push_is_learned_with_objects_that_are_off_by_a_constant(push):
    rng = np.random.default_rng(0)
    one, other = (State(*(jnp.asarray(rng.normal(size=n), float) for n in (13, 13)), jnp.zeros((0, 3))) for _ in "ab")
    off = []
    for key in jax.random.split(jax.random.key(0), 500):
        supposed = push.misjudge(key, one)
        np.testing.assert_array_equal(supposed.qvel, one.qvel)
        off.append(supposed.qpos - one.qpos)
        np.testing.assert_allclose(push.misjudge(key, other).qpos - other.qpos, off[-1], atol=1e-6)
    moved = np.array([7, 8, 10, 11])
    assert not np.delete(np.array(off), moved, axis=1).any(), "the arm and the turns"
    error = np.array(off)[:, moved]
    np.testing.assert_allclose(error.std(axis=0), 0.015, rtol=3 / np.sqrt(2 * 500))
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=3 * 0.015 / np.sqrt(500))
    assert np.abs(np.corrcoef(error.T) - np.eye(4)).max() < 4 / np.sqrt(500)


def test_push_tells_its_expert_the_target_but_no_velocity_of_an_object(push):
    key = jax.random.key(1)
    task = push.sample_task(key, "train")
    state = push.reset(key, task)
    seen = learned.see(push, task, state)
    faster = State(state.qpos, state.qvel.at[7:].set(1.0), state.mocap_pos)
    np.testing.assert_array_equal(learned.see(push, task, faster), seen)
    other = learned.see(push, dataclasses.replace(task, target=1 - task.target), state)
    places = push.objects(state)[:, :2]
    expected = places[1 - task.target] - places[task.target]
    changed = np.asarray(other - seen)
    np.testing.assert_allclose(changed[changed != 0][:2], expected, rtol=1e-4)


def test_push_tells_its_expert_how_far_the_target_reaches(push):
    grid = np.stack(np.meshgrid(*[np.linspace(-3, 3, 601)] * 2), axis=-1)
    angle = np.arange(8) * np.pi / 4
    directions = np.stack([np.cos(angle), np.sin(angle)])
    for key in jax.random.split(jax.random.key(2), 6):
        task = push.sample_task(key, "train")
        state = push.reset(key, task)
        shape = to_geoms(list(SHAPES.values())[int(task.shape[task.target])])
        covered = grid[distance_to_outline(grid, shape.ends, shape.radius) <= 0]
        turn = float(push.objects(state)[task.target, 2])
        world = covered @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        expected = float(task.size[task.target]) * (world @ directions).max(axis=0)
        np.testing.assert_allclose(push.visible(task, state), expected, atol=1e-3)  # a hundredth of a unit of 5 cm
