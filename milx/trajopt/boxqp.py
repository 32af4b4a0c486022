"""Small quadratic programs with bounds, the inner problem of control-limited DDP."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from milx.core.linear_algebra import solve_free

# Fractions of the Newton step to compare, besides the one that ends at the first bound.
_STEP_SIZES = (1.0, 0.5, 0.25, 0.1, 0.01, 0.001)


class Solution(NamedTuple):
    """Minimizer of a box-constrained quadratic program.

    Attributes:
        x: [m], inside the box.
        free: bool [m], False where a bound holds x back.
    """

    x: jax.Array
    free: jax.Array


def solve(
    H: jax.Array, g: jax.Array, low: jax.Array, high: jax.Array, start: jax.Array, *, iterations: int = 6
) -> Solution:
    """Minimizes ½ xᵀHx + gᵀx subject to low ≤ x ≤ high by projected Newton steps.

    Each step moves along the Newton direction of the dimensions that no bound holds back, projected onto the box, as
    in Tassa, Mansard & Todorov 2014. Of a few step sizes the best is taken instead of the first that suffices.

    Args:
        H: positive definite [m, m]; where it is not, the solution is NaN.
        g: [m].
        low: [m], may be -inf.
        high: [m], may be inf.
        start: [m], where the search begins; moved into the box.
        iterations: number of Newton steps. One that meets no new bound is the last needed.
    """
    step_sizes = jnp.asarray(_STEP_SIZES, H.dtype)

    def free_at(x, gradient):
        return ~(((x <= low) & (gradient > 0)) | ((x >= high) & (gradient < 0)))

    def newton_step(_, x):
        gradient = H @ x + g
        direction = -solve_free(H, gradient, free_at(x, gradient))
        # Projection may turn a direction uphill for every step size of a list. Up to the first bound it cannot.
        room = jnp.where(direction > 0, high - x, low - x) / direction
        first_bound = jnp.min(room, initial=1.0, where=direction != 0)
        candidates = jnp.clip(x + jnp.append(step_sizes, first_bound)[:, None] * direction, low, high)
        # Relative to x: at the optimum the differences are far smaller than the objective itself.
        moves = candidates - x
        change = moves @ gradient + 0.5 * jnp.einsum("si,ij,sj->s", moves, H, moves)
        return candidates[jnp.argmin(change)]

    x = lax.fori_loop(0, iterations, newton_step, jnp.clip(start, low, high))
    return Solution(x, free_at(x, H @ x + g))
