"""Convolutions by kernels of a GPU, interpreted, against `jax.lax`."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.meta.task_convolution import convolve_directly

# Images, height, width, channels, filters, kernel, stride: an image of three channels, one whose windows are cut into
# pieces of 64 and 16 numbers, and one with fewer numbers in a row of the kernel than are multiplied at once.
SHAPES = [(2, 9, 11, 3, 5, 5, 2), (1, 6, 7, 16, 4, 5, 3), (2, 5, 6, 4, 3, 3, 1)]


def directly(x, kernel, stride):
    return convolve_directly(x, kernel, stride, interpret=True)


def reference(x, kernel, stride):
    return jax.lax.conv_general_dilated(
        x, kernel, (stride, stride), padding="SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def agree(found, expected):
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * np.abs(theirs).max())


@functools.partial(jax.jit, static_argnums=(0, 3))
def derivatives(conv, inputs, directions, stride):
    """Computes derivatives of a cubic function: forward, reverse, forward over reverse, and reverse over reverse."""

    def cubed(inputs):
        return jnp.sum(conv(*inputs, stride) ** 3)

    forward = jax.jvp(lambda inputs: conv(*inputs, stride), (inputs,), (directions,))
    over_reverse = jax.jvp(jax.grad(cubed), (inputs,), (directions,))
    along = lambda inputs: sum(map(jnp.vdot, jax.grad(cubed)(inputs), directions))  # noqa: E731
    return forward, over_reverse, jax.grad(along)(inputs)


@pytest.mark.parametrize("shape", SHAPES)
def test_value_and_derivatives_are_those_of_lax(rng, shape):
    images, height, width, channels, filters, taps, stride = shape
    sizes = ((images, height, width, channels), (taps, taps, channels, filters))
    inputs, directions = (tuple(jnp.asarray(rng.standard_normal(size)) for size in sizes) for _ in range(2))
    agree(derivatives(directly, inputs, directions, stride), derivatives(reference, inputs, directions, stride))


@pytest.mark.parametrize("of_tasks", ["images and kernels", "images", "kernels", "images twice"])
def test_gradients_of_mapped_convolutions_are_those_of_lax(rng, of_tasks):
    """Maps images, kernels or both over tasks; what tasks share has the sum of their gradients."""
    x, kernel = (jnp.asarray(rng.standard_normal(size)) for size in ((3, 2, 5, 6, 4), (3, 3, 3, 4, 3)))
    axes = {"images and kernels": (0, 0), "images": (0, None), "kernels": (None, 0), "images twice": (0, None)}[
        of_tasks
    ]
    x, kernel = (value if axis == 0 else value[0] for value, axis in zip((x, kernel), axes, strict=True))
    if of_tasks == "images twice":
        x = jnp.stack([x, 2 * x])

    def gradient(conv):
        mapped = jax.vmap(lambda x, kernel: conv(x, kernel, 2), axes)
        mapped = jax.vmap(mapped, (0, None)) if of_tasks == "images twice" else mapped
        return jax.jit(jax.grad(lambda inputs: jnp.sum(mapped(*inputs) ** 3)))((x, kernel))

    agree(gradient(directly), gradient(reference))


@pytest.mark.parametrize(("filters", "message"), [(1, "x: got 3221225472 "), (4096, "outputs: got 4294967296 ")])
def test_more_numbers_than_the_kernels_count_are_refused(filters, message):
    images = 2**20 if filters > 1 else 3 * 2**20
    x = jax.ShapeDtypeStruct((images, 2, 2, 4 if filters > 1 else 256), jnp.float32)
    kernel = jax.ShapeDtypeStruct((3, 3, x.shape[-1], filters), jnp.float32)
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(lambda x, kernel: convolve_directly(x, kernel, 2), x, kernel)
