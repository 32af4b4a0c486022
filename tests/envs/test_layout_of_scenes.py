"""Layouts of things that keep their distances."""

import jax
import jax.numpy as jnp
import numpy as np

from milx.envs.layout import first_spaced


def test_the_first_layout_that_keeps_the_distances_is_taken():
    """Compares with a loop over layouts and pairs."""
    draws = jax.random.uniform(jax.random.key(0), (20, 4, 2))
    for spacing in (0.05, 0.2, 0.3):
        kept = [min(float(jnp.linalg.norm(x[i] - x[j])) for i in range(4) for j in range(i)) for x in draws]
        meet = [n for n, gap in enumerate(kept) if gap >= spacing]
        expected = meet[0] if meet else int(np.argmax(kept))
        np.testing.assert_array_equal(first_spaced(draws, spacing), draws[expected])


def test_the_layout_that_comes_closest_is_taken_where_none_keeps_them():
    draws = jnp.array([[[0.0, 0.0], [0.1, 0.0]], [[0.0, 0.0], [0.3, 0.0]], [[0.0, 0.0], [0.2, 0.0]]])
    np.testing.assert_array_equal(first_spaced(draws, 1.0), draws[1])
