"""Adaptation whose derivative needs no steps: implicit MAML (Rajeswaran, Finn, Kakade & Levine, NeurIPS 2019).

What is adapted minimizes a loss that holds it near the parameters theta it began with,

    phi(theta) = argmin_phi  L(phi, data) + lambda/2 |phi - theta|^2.

At the minimum, with the Hessian H of L there, the derivative follows from the implicit function theorem (their eq. 6),

    d phi / d theta = (I + H / lambda)^-1,

however phi was found. A product of its transpose with a vector is computed by conjugate gradients, so memory does not
grow with the number of steps.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.scipy.sparse.linalg import cg

from milx.meta.steps import Loss, adapt, hessian_product


def implicit_adapt(
    loss: Loss, params: Any, *data: Any, steps: int, rate: Any, strength: float, iterations: int = 20
) -> Any:
    """Minimizes the loss near `params` by gradient descent, with the derivative of the minimum.

    The derivative is right where the steps have converged and the iterations suffice; L + lambda/2 |.|^2 must be convex
    there.

    Args:
        loss: L.
        params: theta.
        data: other arguments of the loss, constants to a meta-gradient.
        steps: of gradient descent on the regularized loss.
        rate: of these steps, as in `adapt`; a constant to a meta-gradient.
        strength: lambda, a number that is not traced. The larger it is, the more is convex.
        iterations: of conjugate gradients, at most.

    Returns:
        phi, as `params`.

    Raises:
        ValueError: as `adapt`; for a strength that is not positive, or no iteration.
    """
    if not strength > 0:
        raise ValueError(f"strength: got {strength}, expected more than 0")
    if iterations < 1:
        raise ValueError(f"iterations: got {iterations}, expected at least 1")
    return _minimum(loss, steps, float(strength), iterations, params, rate, *data)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0, 1, 2, 3))
def _minimum(loss: Loss, steps: int, strength: float, iterations: int, params: Any, rate: Any, *data: Any) -> Any:
    def near(phi: Any, *data: Any) -> jax.Array:
        away = jax.tree.map(lambda a, b: jnp.sum(jnp.square(a - b)), phi, params)
        return loss(phi, *data) + 0.5 * strength * sum(jax.tree.leaves(away))

    return adapt(near, params, *data, steps=steps, rate=rate, order="first_order")


def _forward(loss: Loss, steps: int, strength: float, iterations: int, params: Any, rate: Any, *data: Any):
    phi = _minimum(loss, steps, strength, iterations, params, rate, *data)
    return phi, (phi, data)


def _backward(loss: Loss, steps: int, strength: float, iterations: int, kept: tuple, vector: Any) -> tuple:
    phi, data = kept
    wide = jnp.result_type(jnp.float32, *jax.tree.leaves(phi))  # conjugate gradients need one type

    def regularized(v: Any) -> Any:
        narrow = jax.tree.map(lambda v, p: v.astype(p.dtype), v, phi)
        return jax.tree.map(lambda v, h: v + h.astype(wide) / strength, v, hessian_product(loss, phi, data, narrow))

    found, _ = cg(regularized, jax.tree.map(lambda x: x.astype(wide), vector), maxiter=iterations)
    return jax.tree.map(lambda x, p: x.astype(p.dtype), found, phi), None, *(None for _ in data)


_minimum.defvjp(_forward, _backward)
