"""Small dense systems of linear equations, inside batched loops."""

import jax
import jax.numpy as jnp


def solve_free(H: jax.Array, b: jax.Array, free: jax.Array) -> jax.Array:
    """Solves H_ff y_f = b_f for the free dimensions f and leaves y zero in the others.

    Args:
        H: positive definite [m, m]; where H_ff is not, y is NaN.
        b: [m] or [m, k].
        free: bool [m].

    Returns:
        y, of the shape of b.
    """
    m = len(H)
    H_free = jnp.where(free[:, None] & free, H, jnp.eye(m, dtype=H.dtype))
    b_free = jnp.where(free[:, None], b.reshape(m, -1), 0.0)
    # Gauss-Jordan elimination, unrolled over the m columns: a positive definite matrix needs no pivoting. Calls into
    # LAPACK from inside a batched loop can block each other for ever on a CPU of few cores, and for a matrix this small
    # a call into cuSOLVER takes longer than the arithmetic.
    table = jnp.concatenate([H_free, b_free], axis=1)
    for column in range(m):
        pivot = table[column, column]
        row = table[column] / jnp.where(pivot > 0, pivot, jnp.nan)
        table = (table - table[:, column, None] * row).at[column].set(row)
    return table[:, m:].reshape(b.shape)
