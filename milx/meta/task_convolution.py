"""Convolutions by the kernels of `kernels.py`, as operations that JAX can differentiate, in any order, and map.

There are three, each linear in its two arguments, and the transpose of each in either argument is another of them.
Kernels that all tasks share have a leading axis of 1.
"""

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from milx.meta import kernels


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
        ValueError: for more than 128 filters, or channels where images need a gradient, and for arrays of so many
            numbers, all tasks together, that 32 bits do not count them.
    """
    dtype = jnp.result_type(x, kernel)
    x, kernel = x.astype(dtype), kernel.astype(dtype)
    if x.shape[-1] == 3:  # a pixel of four numbers is read at once
        x, kernel = jnp.pad(x, [(0, 0)] * 3 + [(0, 1)]), jnp.pad(kernel, [(0, 0)] * 2 + [(0, 1), (0, 0)])
    return _convolve.bind(x[None], kernel[None], stride=stride, interpret=interpret)[0]


def _primitive(function: Callable[..., jax.Array]) -> Primitive:
    """Makes an operation of a function of two arrays and static settings, which are its keywords."""
    primitive = Primitive(function.__name__)
    settings = [each.name for each in inspect.signature(function).parameters.values() if each.kind == each.KEYWORD_ONLY]
    jitted = jax.jit(function, static_argnames=settings)  # which traces it once for each shape

    def shaped(*args: Any, **settings: Any) -> Any:
        found = jitted.eval_shape(*(jax.ShapeDtypeStruct(arg.shape, arg.dtype) for arg in args), **settings)
        return jax.core.ShapedArray(found.shape, found.dtype)

    primitive.def_impl(jitted)
    primitive.def_abstract_eval(shaped)
    mlir.register_lowering(primitive, mlir.lower_fun(jitted, multiple_results=False))
    return primitive


_convolve = _primitive(kernels.convolve)
_to_input = _primitive(kernels.to_input)
_to_kernel = _primitive(kernels.to_kernel)


def _gradient(x: jax.Array, dy: jax.Array, kernel: Any, **settings: Any) -> jax.Array:
    """Computes the transpose in a kernel that may be shared: then the sum over the tasks."""
    found = _to_kernel.bind(x, dy, taps=kernel.aval.shape[1], **settings)
    return found.sum(axis=0, keepdims=True) if kernel.aval.shape[0] < len(x) else found


def _size(x: Any) -> tuple[int, ...]:
    return x.aval.shape[2:4]


ad.defbilinear(
    _convolve,
    lambda dy, x, kernel, **settings: _to_input.bind(dy, kernel, size=_size(x), **settings),
    lambda dy, x, kernel, **settings: _gradient(x, dy, kernel, **settings),
)
ad.defbilinear(
    _to_input,
    lambda dx, dy, kernel, size, **settings: _convolve.bind(dx, kernel, **settings),
    lambda dx, dy, kernel, size, **settings: _gradient(dx, dy, kernel, **settings),
)
ad.defbilinear(
    _to_kernel,
    lambda dkernel, x, dy, taps, **settings: _to_input.bind(dy, dkernel, size=_size(x), **settings),
    lambda dkernel, x, dy, taps, **settings: _convolve.bind(x, dkernel, **settings),
)


def _map(primitive: Primitive, args: Sequence[jax.Array], axes: Sequence[int | None], **settings: Any) -> Any:
    """Maps over further tasks: the axis that is mapped joins that of the tasks.

    What is not mapped is repeated, except for a kernel that all tasks share.
    """
    count = next(arg.shape[axis] for arg, axis in zip(args, axes, strict=True) if axis is not None)
    each = [arg[None] if axis is None else jnp.moveaxis(arg, axis, 0) for arg, axis in zip(args, axes, strict=True)]
    tasks = max(arg.shape[1] for arg in each)

    def join(arg: jax.Array) -> jax.Array:
        return jnp.broadcast_to(arg, (count, tasks, *arg.shape[2:])).reshape(-1, *arg.shape[2:])

    shared = primitive is not _to_kernel and each[1].shape[:2] == (1, 1)
    found = primitive.bind(join(each[0]), each[1][0] if shared else join(each[1]), **settings)
    return found.reshape(count, tasks, *found.shape[1:]), 0


for _each in (_convolve, _to_input, _to_kernel):
    batching.primitive_batchers[_each] = functools.partial(_map, _each)
