"""How a scene's things are laid out: far enough from each other."""

import jax
import jax.numpy as jnp
import numpy as np


def first_spaced(draws: jax.Array, spacing: float) -> jax.Array:
    """Returns the first of C layouts that keeps the distances, or the one that comes closest to it.

    Args:
        draws: [C, N, 2], positions of N things in each layout (m).
        spacing: minimum distance of any two of them (m).

    Returns:
        [N, 2], one of the layouts.
    """
    one, other = np.triu_indices(draws.shape[1], 1)
    gap = jnp.linalg.norm(draws[:, one] - draws[:, other], axis=-1).min(axis=-1)
    return draws[jnp.argmax(jnp.minimum(gap, spacing))]
