"""Steps of gradient descent that can be differentiated, on any loss and any pytree of parameters.

With a loss L(theta, data), and for every tensor of theta a rate alpha_k, a mask M, 0 or 1, and a bound c on the entries
of its gradient, step k is

    theta_{k+1} = theta_k - M alpha_k clip(grad_theta L(theta_k, data), -c, c).

Masks make relatives of MAML (Finn et al. 2017): all but the last layer kept (ANIL, Raghu et al. 2020), the last layer
kept (BOIL, Oh et al. 2021), all but a few context parameters kept (CAVIA, Zintgraf et al. 2019). Rates may be part of
what is meta-learned, one for every tensor and step in MAML++ (Antoniou et al. 2019).
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Loss = Callable[..., jax.Array]
"""Maps parameters, a pytree of floating-point arrays, and data, pytrees of arrays, to a scalar. It must not close over
a value that JAX traces: what belongs to a task is passed as data."""
ORDERS = ("forward_over_reverse", "reverse_over_reverse", "first_order")
"""How the derivative of an inner gradient is taken: its product of the Hessian with a vector forward over reverse or
reverse over reverse, which give the same by the parameters, or not at all. Only reverse over reverse differentiates by
the data, too; to the others they are constants, so what is meta-learned belongs in the parameters."""


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _gradient(loss: Loss, params: Any, *data: Any) -> Any:
    return jax.grad(loss)(params, *data)


def _gradient_forward(loss: Loss, params: Any, *data: Any) -> tuple[Any, tuple]:
    return jax.grad(loss)(params, *data), (params, *data)


def _gradient_backward(loss: Loss, inputs: tuple, vector: Any) -> tuple:
    params, *data = inputs
    return hessian_product(loss, params, data, vector), *(None for _ in data)


_gradient.defvjp(_gradient_forward, _gradient_backward)


def hessian_product(loss: Loss, params: Any, data: Any, vector: Any) -> Any:
    """Multiplies the Hessian of loss(params, *data) by a vector, a pytree as `params`, forward over reverse."""
    return jax.jvp(lambda params: jax.grad(loss)(params, *data), (params,), (vector,))[1]


def gradient(loss: Loss, params: Any, *data: Any, order: str = ORDERS[0]) -> Any:
    """Differentiates loss(params, *data); the result can be differentiated by `params`, in reverse.

    Its derivative is a product of the Hessian with a vector. As the Hessian is symmetric (`loss` must not stop the
    gradient of a part of `params` in one place and use it in another), the product may be taken forward over reverse,
    which keeps no intermediate results of the inner gradient for the meta-gradient (Pearlmutter 1994), where reverse
    over reverse keeps them all.

    Args:
        loss: what is differentiated.
        params: where.
        data: other arguments of the loss, constants to a meta-gradient unless `order` is "reverse_over_reverse".
        order: one of ORDERS.

    Raises:
        ValueError: for an order that does not exist.
    """
    if order not in ORDERS:
        raise ValueError(f"order: got {order!r}, expected one of {', '.join(ORDERS)}")
    if order == "forward_over_reverse":
        return _gradient(loss, params, *data)
    found = jax.grad(loss)(params, *data)
    return jax.lax.stop_gradient(found) if order == "first_order" else found


def inner_step(
    loss: Loss,
    params: Any,
    *data: Any,
    rate: Any,
    clip: float | None = None,
    mask: Any = True,
    order: str = ORDERS[0],
) -> Any:
    """Takes one step of gradient descent, as stated at the head of this file.

    Args:
        loss: what descends.
        params: theta_k.
        data: other arguments of the loss, as in `gradient`.
        rate: alpha_k, scalars: one, or a pytree whose structure is that of `params`, or the beginning of it, of the
            same types of nodes.
        clip: c, a number; None for no bound.
        mask: bools: one, or a pytree as `rate`. Tensors with False stay as they are.
        order: one of ORDERS.

    Returns:
        theta_{k+1}, in the data types of `params`.

    Raises:
        ValueError: as `gradient`; for a rate or a mask with another structure, a rate that is no scalar, a mask that is
            no bool, or a negative bound.
    """
    if clip is not None and clip < 0:
        raise ValueError(f"clip: got {clip}, expected at least 0, or None")
    params = jax.tree.map(jnp.asarray, params)
    rates = _for_every_tensor("rate", rate, params)
    for value in jax.tree.leaves(rates):
        if jnp.ndim(value):
            raise ValueError(f"rate: got the shape {jnp.shape(value)}, expected a scalar")

    def step(p: jax.Array, g: jax.Array, rate: jax.Array | float, adapts: bool) -> jax.Array:
        if not adapts:
            return p
        bounded = g if clip is None else jnp.clip(g, -clip, clip)
        return (p - rate * bounded).astype(p.dtype)

    found = gradient(loss, params, *data, order=order)
    return jax.tree.map(step, params, found, rates, _mask(mask, params))


def adapt(
    loss: Loss,
    params: Any,
    *data: Any,
    steps: int,
    rate: Any,
    clip: float | None = None,
    mask: Any = True,
    order: str = ORDERS[0],
    path: bool = False,
    unroll: int = 1,
) -> Any:
    """Takes K steps of gradient descent, in a scan if there are several; it can be differentiated in reverse.

    Args:
        loss: what descends.
        params: theta_0.
        data: other arguments of the loss, as in `gradient`, the same in all steps.
        steps: K; with none `params` are returned.
        rate: as in `inner_step`; instead of a scalar, an array [K] has a rate for every step.
        clip: as in `inner_step`.
        mask: as in `inner_step`.
        order: one of ORDERS.
        path: return theta_1 to theta_K, with a leading axis [K], instead of theta_K.
        unroll: number of steps in an iteration of the scan, at least 1. With K or more no loop is left, which may be
            faster, but takes longer to compile and more memory.

    Raises:
        ValueError: as `inner_step`; for a negative number of steps, a rate that is neither a scalar nor [K], or less
            than one step in an iteration.
    """
    if steps < 0:
        raise ValueError(f"steps: got {steps}, expected at least 0")
    if unroll < 1:
        raise ValueError(f"unroll: got {unroll}, expected at least 1")
    params = jax.tree.map(jnp.asarray, params)
    rates = jax.tree.map(lambda rate: _for_every_step(rate, steps), _for_every_tensor("rate", rate, params))

    def take(params: Any, rates: Any) -> tuple[Any, Any]:
        after = inner_step(loss, params, *data, rate=rates, clip=clip, mask=mask, order=order)
        return after, after if path else None

    if steps == 1:  # a loop of one step would be slower to compile
        last, _ = take(params, jax.tree.map(lambda rate: rate[0], rates))
        return jax.tree.map(lambda x: x[None], last) if path else last
    last, visited = jax.lax.scan(take, params, rates, length=steps, unroll=unroll)
    return visited if path else last


def _for_every_tensor(name: str, values: Any, params: Any) -> Any:
    """Broadcasts the beginning of a pytree to the structure of `params`."""
    try:
        return jax.tree.broadcast(values, params)
    except ValueError as error:
        expected = "one value, or the structure of the parameters or its beginning"
        raise ValueError(f"{name}: got {jax.tree.structure(values)}, expected {expected}: {error}") from error


def _mask(mask: Any, params: Any) -> Any:
    mask = _for_every_tensor("mask", mask, params)
    for value in jax.tree.leaves(mask):
        if not isinstance(value, bool | np.bool_):
            raise ValueError(f"mask: got {value!r}, expected True or False")
    return mask


def _for_every_step(rate: Any, steps: int) -> jax.Array:
    if jnp.ndim(rate) and jnp.shape(rate) != (steps,):
        raise ValueError(f"rate: got the shape {jnp.shape(rate)}, expected a scalar or {steps} steps")
    return jnp.broadcast_to(jnp.asarray(rate), (steps,))
