"""Proximal policy optimization: advantages, the gradient, and where the objective is cut off."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.trajopt import ppo
from milx.trajopt.ppo import Experience


def networks(params, seen):
    """Linear ones, for controls [2] from z [3]."""
    return seen @ params["policy"], params["deviation"], seen @ params["critic"]


@pytest.fixture
def learned():
    """Parameters, and ten rows that they have drawn."""
    rng = np.random.default_rng(0)
    params = {"policy": rng.normal(size=(3, 2)), "deviation": np.array([-0.5, 0.3]), "critic": rng.normal(size=3)}
    params = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), params)
    seen = jnp.asarray(rng.normal(size=(10, 3)), jnp.float32)
    mean, log_deviation, value = networks(params, seen)
    control = mean + jnp.exp(log_deviation) * rng.normal(size=(10, 2))
    chance, gain = ppo.log_probability(control, mean, log_deviation), rng.normal(size=10)
    return params, Experience(seen, control, chance, jnp.asarray(gain, jnp.float32), value + gain)


def test_the_probability_is_that_of_a_normal_distribution():
    rng = np.random.default_rng(1)
    control, mean, log_deviation = rng.normal(size=(5, 2)), rng.normal(size=(5, 2)), np.array([-0.7, 0.4])
    deviation = np.exp(log_deviation)
    density = np.exp(-(((control - mean) / deviation) ** 2) / 2) / (deviation * np.sqrt(2 * np.pi))
    expected = np.log(density).sum(axis=1) + np.log(2 * np.pi)  # the constant of two controls
    np.testing.assert_allclose(ppo.log_probability(control, mean, log_deviation), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("discount", "trace"), [(0.9, 0.8), (1.0, 1.0), (0.95, 0.0)])
def test_advantages_are_the_sums_of_their_definition(discount, trace):
    rng = np.random.default_rng(2)
    reward, value = rng.normal(size=7), np.append(rng.normal(size=7), 0.0)
    change = reward + discount * value[1:] - value[:-1]
    expected = [sum((discount * trace) ** k * change[t + k] for k in range(7 - t)) for t in range(7)]
    found = ppo.advantages(jnp.asarray(reward, float), jnp.asarray(value[:-1], float), discount, trace)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_with_the_policy_that_drew_the_rows_the_gradient_is_the_policy_gradient(learned):
    """-mean B grad log p for the policy, and the mean of (V - target) grad V for the critic."""
    params, rows = learned
    gradient = jax.grad(ppo.loss, argnums=1)(networks, params, rows, 0.2)
    gain = np.asarray(rows.advantage - rows.advantage.mean()) / np.asarray(rows.advantage).std()
    off = np.asarray(rows.control - rows.seen @ params["policy"]) * np.exp(-np.asarray(params["deviation"]))
    score = off * np.exp(-np.asarray(params["deviation"]))
    expected = {
        "policy": -np.einsum("m,mz,mk->zk", gain, rows.seen, score) / 10,
        "deviation": -np.einsum("m,mk->k", gain, off**2 - 1) / 10,
        "critic": np.einsum("m,mz->z", rows.seen @ params["critic"] - rows.target, rows.seen) / 10,
    }
    for name, value in expected.items():
        np.testing.assert_allclose(gradient[name], value, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_nothing_is_gained_by_going_too_far(learned, side):
    """Rows whose probability has moved by more than the limit in the direction that gains have no gradient."""
    params, rows = learned
    moved = rows._replace(log_probability=rows.log_probability - side * 0.5)  # w is 1.6 or 0.6
    gradient = jax.grad(ppo.loss, argnums=1)(networks, params, moved, 0.2)
    gain = np.asarray(rows.advantage - rows.advantage.mean()) / np.asarray(rows.advantage).std()
    kept = side * gain < 0
    ratio = np.exp(side * 0.5)
    off = np.asarray(rows.control - rows.seen @ params["policy"]) * np.exp(-2 * np.asarray(params["deviation"]))
    expected = -np.einsum("m,mz,mk->zk", ratio * gain * kept, rows.seen, off) / 10
    assert 0 < kept.sum() < 10
    np.testing.assert_allclose(gradient["policy"], expected, rtol=1e-3, atol=1e-5)


def test_one_step_is_one_of_adam_on_all_rows(learned):
    params, rows = learned
    options = ppo.Options(epochs=1, minibatches=1, norm=1e6)
    optimizer = ppo.optimizer(options, 10)
    state = optimizer.init(params)
    improve = functools.partial(ppo.improve, networks, options, optimizer)
    found, _ = improve((params, state), rows, jax.random.key(0))
    gradient = jax.grad(ppo.loss, argnums=1)(networks, params, rows, options.clip)
    for name, value in gradient.items():
        expected = params[name] - options.rate * value / (jnp.abs(value) + 1e-8)
        np.testing.assert_allclose(found[name], expected, atol=1e-6)
