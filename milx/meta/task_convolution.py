"""Convolutions by the kernels of `kernels.py`, as operations that JAX can differentiate, in any order, and map.

There are three, each linear in its two arguments, and the transpose of each in either argument is another of them.
Kernels that all tasks share have a leading axis of 1.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching

from milx.meta import kernels
from milx.meta.convolution import same_padding
from milx.meta.operations import MOST_NUMBERS, operation
from milx.meta.tiles import Geometry


def convolve_directly(x: jax.Array, kernel: jax.Array, stride: int, interpret: bool = False) -> jax.Array:
    """Computes `conv2d` by kernels of a GPU: no copies of windows, and little memory.

    Args:
        x: [B, H, W, C].
        kernel: [k, k, C, F].
        stride: the same in both directions.
        interpret: run on any device, slowly, for tests.

    Returns:
        [B, ceil(H / stride), ceil(W / stride), F].

    Raises:
        ValueError: for more than 64 filters or channels, and for so many numbers in the images of a task that 32 bits
            do not count them.
    """
    dtype = jnp.result_type(x, kernel)
    x, kernel = x.astype(dtype), kernel.astype(dtype)
    size, taps = x.shape[1:3], kernel.shape[0]
    rows, columns = (same_padding(length, taps, stride)[0] for length in size)
    shape = -(-size[0] // stride), -(-size[1] // stride)
    if (fewer := 4 - x.shape[-1]) > 0:  # images of four channels, and an even width, are read 16 bytes at once
        x = jnp.pad(x, ((0, 0), (0, 0), (0, size[1] % 2), (0, fewer)))
        kernel = jnp.pad(kernel, ((0, 0), (0, 0), (0, fewer), (0, 0)))
    geometry = Geometry(stride, taps, (rows, columns), (x.shape[1], x.shape[2]), shape)
    return _convolve.bind(x[None], kernel[None], geometry=geometry, interpret=interpret)[0]


_convolve = operation(kernels.convolve)
_to_input = operation(kernels.to_input)
_to_kernel = operation(kernels.to_kernel)


def _gradient(x: jax.Array, dy: jax.Array, kernel: Any, **settings: Any) -> jax.Array:
    """Computes the transpose in a kernel that may be shared: then the sum over the tasks."""
    found = _to_kernel.bind(x, dy, **settings)
    return found.sum(axis=0, keepdims=True) if kernel.aval.shape[0] < len(x) else found


ad.defbilinear(
    _convolve,
    lambda dy, x, kernel, **settings: _to_input.bind(dy, kernel, **settings),
    lambda dy, x, kernel, **settings: _gradient(x, dy, kernel, **settings),
)
ad.defbilinear(
    _to_input,
    lambda dx, dy, kernel, **settings: _convolve.bind(dx, kernel, **settings),
    lambda dx, dy, kernel, **settings: _gradient(dx, dy, kernel, **settings),
)
ad.defbilinear(
    _to_kernel,
    lambda dkernel, x, dy, **settings: _to_input.bind(dy, dkernel, **settings),
    lambda dkernel, x, dy, **settings: _convolve.bind(x, dkernel, **settings),
)


def _map(primitive: Primitive, args: Sequence[jax.Array], axes: Sequence[int | None], **settings: Any) -> Any:
    """Maps over further tasks: the axis that is mapped joins that of the tasks.

    What is not mapped is repeated, except for a kernel that all tasks share. Where 32 bits do not count the numbers of
    all tasks, one is computed after the other.
    """
    count = next(arg.shape[axis] for arg, axis in zip(args, axes, strict=True) if axis is not None)
    each = [arg[None] if axis is None else jnp.moveaxis(arg, axis, 0) for arg, axis in zip(args, axes, strict=True)]
    tasks = max(arg.shape[1] for arg in each)

    def join(arg: jax.Array) -> jax.Array:
        return jnp.broadcast_to(arg, (count, tasks, *arg.shape[2:])).reshape(-1, *arg.shape[2:])

    geometry = settings["geometry"]
    channels, filters = (each[0].shape[-1], each[1].shape[-1]) if primitive is _to_kernel else each[1].shape[-2:]
    pixels = max(math.prod(geometry.size) * channels, math.prod(geometry.shape) * filters)
    if count * tasks * each[0].shape[2] * pixels > MOST_NUMBERS:
        repeated = [jnp.broadcast_to(arg, (count, *arg.shape[1:])) for arg in each]
        return jax.lax.map(lambda pair: primitive.bind(*pair, **settings), repeated), 0
    shared = primitive is not _to_kernel and each[1].shape[:2] == (1, 1)
    found = primitive.bind(join(each[0]), each[1][0] if shared else join(each[1]), **settings)
    return found.reshape(count, tasks, *found.shape[1:]), 0


for _each in (_convolve, _to_input, _to_kernel):
    batching.primitive_batchers[_each] = functools.partial(_map, _each)
