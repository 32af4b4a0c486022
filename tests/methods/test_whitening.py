"""Whitening against NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.methods import whitening


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture
def data():
    """Samples states [3, 4, 5, 6] and actions [3, 4, 5, 2] of very different scales."""
    rng = np.random.default_rng(0)
    state = np.logspace(-2, 3, 6) * rng.standard_normal((3, 4, 5, 6)) + np.arange(6)
    return state, 0.2 * rng.standard_normal((3, 4, 5, 2)) + [0.5, -3.0]


def test_training_data_become_standard(data):
    state, action = data
    fitted = whitening.fit(*map(jnp.asarray, data), whiten_actions=True)
    flat = state.reshape(-1, 6)
    np.testing.assert_allclose(fitted.state_mean, flat.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(fitted.state_scale, flat.std(axis=0), rtol=1e-12)
    np.testing.assert_allclose(fitted.action_mean, action.reshape(-1, 2).mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(fitted.action_scale, action.reshape(-1, 2).std(axis=0), rtol=1e-12)
    for white in (fitted.state(state), fitted.action(action)):
        np.testing.assert_allclose(white.mean(axis=(0, 1, 2)), 0, atol=1e-12)
        np.testing.assert_allclose(white.std(axis=(0, 1, 2)), 1, rtol=1e-12)


def test_entries_that_hardly_vary_are_divided_by_the_floor(data):
    rng = np.random.default_rng(1)
    still = 2.0 + np.array([0.0, 1e-5, 0.9e-3, 1.1e-3]) * np.sign(rng.standard_normal((1000, 4)))
    fitted = whitening.fit(jnp.asarray(still), jnp.asarray(still), whiten_actions=True)
    for scale in (fitted.state_scale, fitted.action_scale):
        np.testing.assert_array_equal(scale[:3], whitening.MIN_STD)
        np.testing.assert_allclose(scale[3], still[:, 3].std(), rtol=1e-9)
    assert whitening.MIN_STD == 1e-3
    np.testing.assert_allclose(fitted.state(still)[:, :3], 1e3 * (still - still.mean(axis=0))[:, :3], atol=1e-9)


@pytest.mark.parametrize("whiten_actions", [True, False])
def test_unwhitening_is_the_inverse(data, whiten_actions):
    _, action = data
    fitted = whitening.fit(*map(jnp.asarray, data), whiten_actions=whiten_actions)
    np.testing.assert_allclose(fitted.unwhiten_action(fitted.action(action)), action, rtol=1e-12)
    np.testing.assert_allclose(fitted.action(fitted.unwhiten_action(action)), action, rtol=1e-12)
    if not whiten_actions:
        np.testing.assert_array_equal(fitted.action(action), action)
