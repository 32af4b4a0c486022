"""Bias, layer norm, center and ReLU of images by a GPU's sums over pixels, in few passes over the images.

With the sums X and Q of x and of its square over the P pixels of each channel, x + bias has the mean m and the mean
square q of all its numbers, the means over the channels of

    X / P + bias        and        Q / P + 2 bias X / P + bias^2,

so with the scale r = (q - m^2 + 1e-6)^(-1/2) the result is relu(x r + s), s = (bias - m) r + center. Its gradient by r
and s needs the sums of the gradient g over the pixels where x r + s > 0, and those of g x. Nothing else is a sum over
pixels, so forward and backward read the images twice each.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp

from milx.meta.pixel_sums import pixel_sums, scale_and_shift


@functools.partial(jax.custom_vjp, nondiff_argnums=(3, 4))
def normalize(x: jax.Array, bias: jax.Array, center: jax.Array, dtype: Any, interpret: bool = False) -> jax.Array:
    """Computes relu(layer_norm(x + bias) + center).

    It can be differentiated in reverse, and forward over reverse, but not forward alone.

    Args:
        x: [B, H, W, F].
        bias: [F].
        center: [F].
        dtype: of the result.
        interpret: run the kernel on any device, slowly, for tests.
    """
    return _forward(x, bias, center, dtype, interpret)[0]


def _forward(x: jax.Array, bias: jax.Array, center: jax.Array, dtype: Any, interpret: bool) -> tuple[jax.Array, tuple]:
    sums = pixel_sums(x, x, interpret=interpret)
    y = scale_and_shift(x, *_statistics(x.shape[1] * x.shape[2], *sums, bias, center))
    return jnp.maximum(y, 0).astype(dtype), (x, *sums, bias, center)


def _statistics(
    pixels: int, total: jax.Array, squares: jax.Array, bias: jax.Array, center: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Computes r [B] and s [B, F] from the sums [B, F] over so many pixels."""
    first, second = total / pixels, squares / pixels
    mean = (first + bias).mean(axis=1)
    square = (second + 2 * bias * first + jnp.square(bias)).mean(axis=1)
    scale = jax.lax.rsqrt(jnp.maximum(square - jnp.square(mean), 0.0) + 1e-6)
    return scale, (bias - mean[:, None]) * scale[:, None] + center


def _backward(_: Any, interpret: bool, kept: tuple, gradient: jax.Array) -> tuple[jax.Array, ...]:
    x, *small = kept
    gate, transpose = jax.vjp(functools.partial(_statistics, x.shape[1] * x.shape[2]), *small)
    given = gradient.astype(x.dtype)
    by_shift, by_scale = pixel_sums(given, x, gate, interpret)
    by_statistics = by_scale.sum(axis=1).astype(gate[0].dtype), by_shift.astype(gate[1].dtype)
    by_total, by_squares, by_bias, by_center = transpose(by_statistics)
    passed = jnp.where(scale_and_shift(x, *gate) > 0, given, 0)
    by_x = passed * gate[0][:, None, None, None] + by_total[:, None, None] + 2 * x * by_squares[:, None, None]
    return by_x.astype(x.dtype), by_bias, by_center


normalize.defvjp(_forward, _backward)
