"""Solutions of small dense systems of linear equations inside batched loops."""

import jax
import jax.numpy as jnp


def solve_free(H: jax.Array, b: jax.Array, free: jax.Array) -> jax.Array:
    """Solves H_ff y_f = b_f for the free dimensions f; y is zero in all other dimensions.

    Args:
        H: positive definite matrix [m, m]; if H_ff is not positive definite, y is NaN.
        b: right-hand side, [m] or [m, k].
        free: bool [m], True for the free dimensions.

    Returns:
        y, with the shape of b.
    """
    m = len(H)
    H_free = jnp.where(free[:, None] & free, H, jnp.eye(m, dtype=H.dtype))
    b_free = jnp.where(free[:, None], b.reshape(m, -1), 0.0)
    # Gauss-Jordan elimination, unrolled over the m columns; a positive definite matrix needs no pivoting. LAPACK and
    # cuSOLVER are not used: LAPACK calls in a batched loop can block each other forever on a CPU with few cores, and a
    # cuSOLVER call takes longer than the arithmetic for a matrix this small.
    table = jnp.concatenate([H_free, b_free], axis=1)
    for column in range(m):
        pivot = table[column, column]
        row = table[column] / jnp.where(pivot > 0, pivot, jnp.nan)
        table = (table - table[:, column, None] * row).at[column].set(row)
    return table[:, m:].reshape(b.shape)
