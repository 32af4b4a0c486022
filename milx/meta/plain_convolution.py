"""What `kernels.py` computes, by XLA's convolution, for devices that have no such kernels."""

import functools

import jax
import jax.numpy as jnp

from milx.meta.tiles import Geometry


def convolve(*pairs: jax.Array, geometry: Geometry) -> jax.Array:
    """Computes what `kernels.convolve` computes."""
    axes = zip(geometry.size, geometry.before, geometry.shape, strict=True)
    pads = [(before, (n - 1) * geometry.stride + geometry.taps - size - before) for size, before, n in axes]

    def one(x: jax.Array, kernel: jax.Array) -> jax.Array:
        strides, numbers = (geometry.stride,) * 2, ("NHWC", "HWIO", "NHWC")
        return jax.lax.conv_general_dilated(x, kernel, strides, pads, dimension_numbers=numbers)

    def of_tasks(x: jax.Array, kernel: jax.Array) -> jax.Array:
        return jax.vmap(one)(x, jnp.broadcast_to(kernel, (len(x), *kernel.shape[1:])))

    return functools.reduce(jnp.add, map(of_tasks, pairs[::2], pairs[1::2]))


def to_input(*pairs: jax.Array, geometry: Geometry) -> jax.Array:
    """Computes what `kernels.to_input` computes."""

    def of_pair(dy: jax.Array, kernel: jax.Array) -> jax.Array:
        x = jax.ShapeDtypeStruct((*dy.shape[:2], *geometry.size, kernel.shape[3]), dy.dtype)
        return jax.linear_transpose(lambda x: convolve(x, kernel, geometry=geometry), x)(dy)[0]

    return functools.reduce(jnp.add, map(of_pair, pairs[::2], pairs[1::2]))


def to_kernel(*pairs: jax.Array, geometry: Geometry) -> jax.Array:
    """Computes what `kernels.to_kernel` computes."""

    def of_pair(x: jax.Array, dy: jax.Array) -> jax.Array:
        shape = len(x), geometry.taps, geometry.taps, x.shape[-1], dy.shape[-1]
        kernel = jax.ShapeDtypeStruct(shape, x.dtype)
        return jax.linear_transpose(lambda kernel: convolve(x, kernel, geometry=geometry), kernel)(dy)[0]

    return functools.reduce(jnp.add, map(of_pair, pairs[::2], pairs[1::2]))
