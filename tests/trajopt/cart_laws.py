"""Laws of every expert that demonstrates on the cart of `conftest.py` by sampling."""

import jax
import jax.numpy as jnp
import numpy as np


def check_that_noise_alone_is_not_recorded(demonstrate, scenes, deviation):
    """Infers what drove the cart from its velocities: without noise the action, and otherwise what spreads so."""
    for noise in (0.0, deviation):
        drawn = _drawn(*demonstrate(noise, *scenes))
        off = drawn[np.isfinite(drawn)]
        assert off.size > 300
        # Three standard errors of a standard deviation.
        np.testing.assert_allclose(np.sqrt((off**2).mean()), noise, rtol=3 / np.sqrt(2 * off.size), atol=1e-5)


def check_that_noise_alone_tells_demonstrations_of_a_scene_apart(demonstrate, scenes, deviation):
    """Without noise they are the same, and every demonstration and step draws noise of its own."""
    task, start = jax.tree.map(lambda x: jnp.repeat(x[:1], len(x), axis=0), scenes[:2])
    _, alike = demonstrate(0.0, task, start, scenes[2])
    np.testing.assert_allclose(alike, jnp.repeat(alike[:1], len(alike), axis=0), atol=1e-6)
    drawn = _drawn(*demonstrate(deviation, task, start, scenes[2]))
    apart, count = drawn - np.nanmean(drawn, axis=0), np.isfinite(drawn).sum()
    assert count > 300
    np.testing.assert_allclose(np.sqrt(np.nanmean(apart**2)), deviation, rtol=3 / np.sqrt(2 * count))
    neighbors = apart[:, 1:] * apart[:, :-1] / deviation**2
    assert abs(np.nanmean(neighbors)) < 3 / np.sqrt(np.isfinite(neighbors).sum()), "every step draws its own"


def _drawn(states, actions):
    """Returns the noise [N, T] of demonstrations, NaN where the action's limits hide it."""
    driven = np.diff(states.qvel[..., 0], axis=1) / 0.25
    return np.where(np.abs(driven) < 0.99, driven - actions[..., 0], np.nan)
