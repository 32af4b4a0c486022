"""Convolutions by kernels of a GPU, interpreted, against `jax.lax`."""

import functools
import re

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
from lax_convolution import all_derivatives, assert_agree, reference_conv2d

from milx.meta import kernels, operations, task_convolution
from milx.meta.task_convolution import convolve_directly
from milx.meta.tiles import Geometry

# Images, height, width, channels, filters, kernel and stride.
SHAPES = {
    "three channels": (2, 9, 11, 3, 5, 5, 2),
    "tiles of four outputs": (2, 9, 11, 3, 16, 5, 2),
    "rows of several pieces": (1, 6, 7, 16, 4, 5, 3),
    "many filters": (1, 5, 6, 8, 33, 3, 2),
    "several images at once, and a rest": (5, 3, 4, 4, 3, 3, 1),
    "a single pixel": (2, 5, 4, 4, 3, 1, 1),
    "pixels that no window covers": (2, 7, 8, 2, 3, 2, 3),
}


def directly(x, kernel, stride):
    return convolve_directly(x, kernel, stride, interpret=True)


def agree_with_lax(rng, shape):
    images, height, width, channels, filters, taps, stride = shape
    sizes = ((images, height, width, channels), (taps, taps, channels, filters))
    inputs, directions = (tuple(jnp.asarray(rng.standard_normal(size)) for size in sizes) for _ in range(2))
    found, expected = (all_derivatives(conv, inputs, directions, stride) for conv in (directly, reference_conv2d))
    assert_agree(found, expected, 1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_value_and_derivatives_are_those_of_lax(rng, shape):
    agree_with_lax(rng, SHAPES[shape])


@pytest.mark.parametrize(
    ("name", "value", "images"),
    [("_KEPT", 0, 6), ("_SUMS", 0, 7), ("PROGRAMS", 1, 8), ("_SUMMING", 64, 9), ("_TOTALS", 512, 10)],
)
def test_programs_may_keep_less_and_share_more(rng, monkeypatch, name, value, images):
    """Keeps no weights, has the sums for one row of windows, or for all places, or shares images among programs.

    With few sums in all, fewer windows are multiplied at once.

    Each has a number of images of its own, since JAX keeps what it has traced.
    """
    monkeypatch.setattr(kernels, name, value)
    agree_with_lax(rng, (images, 8, 9, 5, 6, 3, 2))


def test_other_devices_convolve_by_xla(rng):
    sizes = (2, 7, 8, 3), (4, 4, 3, 5)
    inputs, directions = (tuple(jnp.asarray(rng.standard_normal(size)) for size in sizes) for _ in range(2))
    found, expected = (all_derivatives(conv, inputs, directions, 3) for conv in (convolve_directly, reference_conv2d))
    assert_agree(found, expected, 1e-12)


def test_a_saved_program_has_no_kernels_of_a_gpu(rng):
    """Saves a gradient for two platforms, and runs it on a CPU; without `portable` it could not be saved."""
    x, kernel = (jnp.asarray(rng.standard_normal(shape)) for shape in ((2, 7, 8, 3), (3, 3, 3, 5)))

    def gradient(kernel):
        return jax.grad(lambda kernel: jnp.sum(convolve_directly(x, kernel, 2) ** 3))(kernel)

    save = jax.export.export(jax.jit(gradient), platforms=("cpu", "cuda"))
    with operations.portable():
        saved = save(jax.ShapeDtypeStruct(kernel.shape, kernel.dtype)).serialize()
    found = jax.export.deserialize(bytearray(saved)).call(kernel)
    expected = jax.grad(lambda kernel: jnp.sum(reference_conv2d(x, kernel, 2) ** 3))(kernel)
    assert_agree(found, expected, 1e-12)
    lowered = jax.jit(gradient).trace(kernel.astype(jnp.float32)).lower(lowering_platforms=("cuda",))
    assert "triton" in lowered.as_text()


@pytest.mark.parametrize("shape", [(3, 3, 2, 5), (2, 3, 4, 5), (3, 3, 5)])
def test_kernels_that_do_not_fit_are_refused(shape):
    expected = rf"kernel: got shape {re.escape(str(shape))}, expected \[k, k, 4, F\]"
    with pytest.raises(ValueError, match=expected):
        convolve_directly(jnp.zeros((1, 5, 6, 4)), jnp.zeros(shape), 2)


@pytest.mark.parametrize(
    "axes",
    [[(0, 0)], [(0, None)], [(None, 0)], [(3, 1)], [(0, None), (0, None)], [(None, 0), (0, None)], [(0, None), (0, 0)]],
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


def test_more_numbers_than_32_bits_count_are_computed_task_by_task(rng, monkeypatch):
    x, kernel = (jnp.asarray(rng.standard_normal(shape)) for shape in ((3, 2, 5, 6, 4), (3, 3, 3, 4, 3)))

    def gradient(conv):
        return jax.grad(lambda inputs: jnp.sum(jax.vmap(lambda *pair: conv(*pair, 2))(*inputs) ** 3))((x, kernel))

    monkeypatch.setattr(task_convolution, "MOST_NUMBERS", 2 * 5 * 6 * 4 + 10)
    assert "scan" in str(jax.make_jaxpr(lambda: gradient(directly))())
    assert_agree(gradient(directly), gradient(reference_conv2d), 1e-12)


@pytest.mark.parametrize(
    ("images", "channels", "message"),
    [
        (2**15, 8, "convolve: got an array of 4294967296 numbers, expected at most 2130706432"),
        (1, 65, r"kernel: got shape \(3, 3, 65, 8\), expected at most 64 channels and filters"),
    ],
)
def test_sizes_that_the_kernels_cannot_have_are_refused(images, channels, message):
    x = jax.ShapeDtypeStruct((images, 128, 128, channels), jnp.float32)
    kernel = jax.ShapeDtypeStruct((3, 3, channels, 8), jnp.float32)
    with pytest.raises(ValueError, match=message):
        jax.eval_shape(lambda x, kernel: directly(x, kernel, 2), x, kernel)


@pytest.mark.parametrize(("channels", "filters", "stride"), [(4, 16, 2), (64, 64, 1)])
def test_programs_read_ahead_what_shared_memory_holds(monkeypatch, channels, filters, stride):
    """With one pair of images three steps fit into an H200's 227 KiB, with two they do not."""
    stages = []

    def record(program, shape, dtype, *settings):
        stages.append(settings[-2])
        return lambda *arrays: jnp.zeros(shape, dtype)

    monkeypatch.setattr(kernels, "_call", record)
    size = 40, 40
    geometry = Geometry(stride, 5, (2, 2), size, tuple(-(-length // stride) for length in size))
    x = jax.ShapeDtypeStruct((2, 8, *size, channels), jnp.bfloat16)
    dy = jax.ShapeDtypeStruct((2, 8, *geometry.shape, filters), jnp.bfloat16)
    for pairs in (1, 2):
        jax.eval_shape(functools.partial(kernels.to_kernel, geometry=geometry), *([x, dy] * pairs))
    assert stages == [3, 1]
