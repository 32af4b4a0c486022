"""Convolutions by kernels of a GPU, interpreted, against `jax.lax`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lax_convolution import all_derivatives, assert_agree, reference_conv2d

from milx.meta import kernels
from milx.meta.task_convolution import convolve_directly

# Images, height, width, channels, filters, kernel and stride.
SHAPES = {
    "three channels": (2, 9, 11, 3, 5, 5, 2),
    "rows of several pieces": (1, 6, 7, 16, 4, 5, 3),
    "several programs": (2, 14, 15, 4, 3, 3, 1),
    "a single pixel": (2, 5, 4, 4, 3, 1, 1),
    "pixels that no window covers": (2, 7, 8, 2, 3, 2, 3),
}


def directly(x, kernel, stride):
    return convolve_directly(x, kernel, stride, interpret=True)


@pytest.mark.parametrize("shape", SHAPES)
def test_value_and_derivatives_are_those_of_lax(rng, monkeypatch, shape):
    images, height, width, channels, filters, taps, stride = SHAPES[shape]
    monkeypatch.setattr(kernels, "_PROGRAMS", 2 * taps)  # two of them sum, in several steps if there are 420 outputs
    sizes = ((images, height, width, channels), (taps, taps, channels, filters))
    inputs, directions = (tuple(jnp.asarray(rng.standard_normal(size)) for size in sizes) for _ in range(2))
    found, expected = (all_derivatives(conv, inputs, directions, stride) for conv in (directly, reference_conv2d))
    assert_agree(found, expected, 1e-12)


@pytest.mark.parametrize(
    "axes", [[(0, 0)], [(0, None)], [(None, 0)], [(3, 1)], [(0, None), (0, None)], [(None, 0), (0, None)]]
)
def test_gradients_of_mapped_convolutions_are_those_of_lax(rng, axes):
    """Maps images, kernels or both over tasks, once or twice; what tasks share has the sum of their gradients."""
    shapes = [[2, 5, 6, 4], [3, 3, 4, 3]]
    for pair in axes:
        for shape, axis in zip(shapes, pair, strict=True):
            if axis is not None:
                shape.insert(axis, 2)
    inputs = tuple(jnp.asarray(rng.standard_normal(shape)) for shape in shapes)

    def gradient(conv):
        mapped = lambda x, kernel: conv(x, kernel, 2)  # noqa: E731
        for pair in axes:
            mapped = jax.vmap(mapped, pair)
        return jax.jit(jax.grad(lambda inputs: jnp.sum(mapped(*inputs) ** 3)))(inputs)

    assert_agree(gradient(directly), gradient(reference_conv2d), 1e-12)


def test_products_of_bfloat16_are_summed_in_float32(rng):
    """Compares the gradient of a kernel, a sum over 1,200 pixels, with float64, from the same rounded numbers."""
    x, kernel = (jnp.asarray(rng.random(shape)).astype(jnp.bfloat16) for shape in ((3, 20, 20, 4), (3, 3, 4, 5)))

    def gradient(conv, x, kernel):
        return jax.jit(jax.grad(lambda kernel: conv(x, kernel, 1).sum()))(kernel)

    expected = gradient(reference_conv2d, x.astype(float), kernel.astype(float))
    np.testing.assert_allclose(gradient(directly, x, kernel).astype(float), expected, rtol=2**-8)


@pytest.mark.parametrize(
    ("tasks", "channels", "filters", "message"),
    [
        (2**14, 8, 8, "convolve: got an array of 4294967296 numbers, expected at most 2147418112"),
        (1, 4, 129, "filters or channels: got 129, expected at most 128"),
    ],
)
def test_sizes_that_the_kernels_cannot_have_are_refused(tasks, channels, filters, message):
    x = jax.ShapeDtypeStruct((tasks, 2, 128, 128, channels), jnp.float32)
    kernel = jax.ShapeDtypeStruct((3, 3, channels, filters), jnp.float32)
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(jax.vmap(lambda x, kernel: directly(x, kernel, 2), (0, None)), x, kernel)
