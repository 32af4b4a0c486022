"""Convolutions by the kernels of `kernels.py`, as operations that JAX can differentiate, in any order, and map.

There are three, each a sum over pairs of arguments and linear in both of a pair, and the transpose of each in either
argument is another of them. The derivative of a product of two is a sum over two pairs, so it is one operation, which
writes one result. Kernels that all tasks share have a leading axis of 1.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching

from milx.meta import kernels, plain_convolution
from milx.meta.convolution import MOST_CHANNELS, same_padding
from milx.meta.operations import MOST_NUMBERS, MOST_TASKS, operation
from milx.meta.tiles import Geometry


def convolve_directly(x: jax.Array, kernel: jax.Array, stride: int, interpret: bool = False) -> jax.Array:
    """Computes `conv2d` by kernels of a GPU, without copies of windows; on other devices by XLA's convolution.

    A number that is not finite may reach all outputs of its tile (`tiles.py`), not only those that depend on it.

    Args:
        x: [B, H, W, C].
        kernel: [k, k, C, F].
        stride: the same in both directions.
        interpret: run on any device, slowly, for tests.

    Returns:
        [B, ceil(H / stride), ceil(W / stride), F].

    Raises:
        ValueError: for a kernel that is not square or has other channels than x, for more than 64 filters or channels,
            and for so many numbers in the images of a task that 32 bits do not count them.
    """
    if kernel.ndim != 4 or kernel.shape[:3] != (kernel.shape[0], kernel.shape[0], x.shape[-1]):
        raise ValueError(f"kernel: got shape {kernel.shape}, expected [k, k, {x.shape[-1]}, F]")
    if max(kernel.shape[2:]) > MOST_CHANNELS:
        raise ValueError(f"kernel: got shape {kernel.shape}, expected at most {MOST_CHANNELS} channels and filters")
    dtype = jnp.result_type(x, kernel)
    x, kernel = x.astype(dtype), kernel.astype(dtype)
    size, taps = x.shape[1:3], kernel.shape[0]
    rows, columns = (same_padding(length, taps, stride)[0] for length in size)
    shape = -(-size[0] // stride), -(-size[1] // stride)
    if x.shape[-1] <= 4:  # images of four channels, and an even width, are read 16 bytes at once
        fewer = 4 - x.shape[-1]
        x = jnp.pad(x, ((0, 0), (0, 0), (0, size[1] % 2), (0, fewer)))
        kernel = jnp.pad(kernel, ((0, 0), (0, 0), (0, fewer), (0, 0)))
    geometry = Geometry(stride, taps, (rows, columns), (x.shape[1], x.shape[2]), shape)
    return _convolve.bind(x[None], kernel[None], geometry=geometry, interpret=interpret)[0]


_convolve = operation(kernels.convolve, plain_convolution.convolve)
_to_input = operation(kernels.to_input, plain_convolution.to_input)
_to_kernel = operation(kernels.to_kernel, plain_convolution.to_kernel)


def _jvp(primitive: Primitive, primals: Sequence[Any], tangents: Sequence[Any], **settings: Any) -> tuple[Any, Any]:
    """Computes the sums over pairs of a b, and of da b + a db, which is one operation, too."""
    value = primitive.bind(*primals, **settings)
    pairs = []
    for a, b, da, db in zip(primals[::2], primals[1::2], tangents[::2], tangents[1::2], strict=True):
        pairs += [] if isinstance(da, ad.Zero) else [da, b]
        pairs += [] if isinstance(db, ad.Zero) else [a, db]
    return value, primitive.bind(*pairs, **settings)


def _by_kernel(x: jax.Array, dy: jax.Array, kernel: Any, **settings: Any) -> jax.Array:
    """Computes the transpose in a kernel that may be shared: then the sum over the tasks."""
    found = _to_kernel.bind(x, dy, **settings)
    return found.sum(axis=0, keepdims=True) if kernel.aval.shape[0] < len(x) else found


# Transposes in the first and in the second argument of a pair, of the gradient by the result, the other argument, and
# the argument itself.
_TRANSPOSES: dict[Primitive, tuple[Callable[..., Any], Callable[..., Any]]] = {
    _convolve: (
        lambda dy, kernel, _, **settings: _to_input.bind(dy, kernel, **settings),
        lambda dy, x, kernel, **settings: _by_kernel(x, dy, kernel, **settings),
    ),
    _to_input: (
        lambda dx, kernel, _, **settings: _convolve.bind(dx, kernel, **settings),
        lambda dx, dy, kernel, **settings: _by_kernel(dx, dy, kernel, **settings),
    ),
    _to_kernel: (
        lambda dkernel, dy, _, **settings: _to_input.bind(dy, dkernel, **settings),
        lambda dkernel, x, _, **settings: _convolve.bind(x, dkernel, **settings),
    ),
}


def _transpose(primitive: Primitive, gradient: Any, *pairs: Any, **settings: Any) -> list[Any]:
    """Computes the gradients by those arguments that are not known, one of a pair at most."""
    if isinstance(gradient, ad.Zero):
        return [ad.Zero(arg.aval) if ad.is_undefined_primal(arg) else None for arg in pairs]
    by_first, by_second = _TRANSPOSES[primitive]
    found: list[Any] = []
    for a, b in zip(pairs[::2], pairs[1::2], strict=True):
        found.append(by_first(gradient, b, a, **settings) if ad.is_undefined_primal(a) else None)
        found.append(by_second(gradient, a, b, **settings) if ad.is_undefined_primal(b) else None)
    return found


def _map(primitive: Primitive, args: Sequence[jax.Array], axes: Sequence[int | None], **settings: Any) -> Any:
    """Maps over further tasks: the axis that is mapped joins that of the tasks.

    What is not mapped is repeated, except for kernels that all tasks share. If there are too many tasks, or if 32 bits
    do not count the numbers of their images, one is computed after the other.
    """
    count = next(arg.shape[axis] for arg, axis in zip(args, axes, strict=True) if axis is not None)
    each = [arg[None] if axis is None else jnp.moveaxis(arg, axis, 0) for arg, axis in zip(args, axes, strict=True)]
    tasks = max(arg.shape[1] for arg in each)
    geometry = settings["geometry"]
    channels, filters = (each[0].shape[-1], each[1].shape[-1]) if primitive is _to_kernel else each[1].shape[-2:]
    pixels = max(math.prod(geometry.size) * channels, math.prod(geometry.shape) * filters)
    if count * tasks > MOST_TASKS or count * tasks * each[0].shape[2] * pixels > MOST_NUMBERS:
        repeated = [jnp.broadcast_to(arg, (count, *arg.shape[1:])) for arg in each]
        return jax.lax.map(lambda args: primitive.bind(*args, **settings), repeated), 0

    def join(number: int, arg: jax.Array) -> jax.Array:
        if primitive is not _to_kernel and number % 2 and arg.shape[:2] == (1, 1):
            return arg[0]
        return jnp.broadcast_to(arg, (count, tasks, *arg.shape[2:])).reshape(-1, *arg.shape[2:])

    found = primitive.bind(*(join(number, arg) for number, arg in enumerate(each)), **settings)
    return found.reshape(count, tasks, *found.shape[1:]), 0


for _each in (_convolve, _to_input, _to_kernel):
    ad.primitive_jvps[_each] = functools.partial(_jvp, _each)
    ad.primitive_transposes[_each] = functools.partial(_transpose, _each)
    batching.primitive_batchers[_each] = functools.partial(_map, _each)
