"""Convolutions against `jax.lax`."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lax_convolution import assert_agree, reference_conv2d

from milx.meta import convolution, task_convolution


@functools.partial(jax.jit, static_argnums=(0, 3))
def derivatives(conv, inputs, directions, stride):
    """Computes value, gradient and Hessian-vector product of a cubic function of a convolution of (x, kernel)."""

    def cubed(inputs):
        return jnp.sum(conv(*inputs, stride) ** 3)

    gradient, product = jax.jvp(jax.grad(cubed), (inputs,), (directions,))
    return conv(*inputs, stride), gradient, product


@pytest.mark.parametrize("convolve", [convolution.convolve_patches, convolution.convolve_blocks])
@pytest.mark.parametrize("shape", [(8, 10), (7, 9)])
@pytest.mark.parametrize("kernel", [1, 3, 5])
@pytest.mark.parametrize("stride", [1, 2, 3])
def test_convolution_and_its_derivatives_are_those_of_lax(rng, convolve, shape, kernel, stride):
    sizes = ((2, *shape, 3), (kernel, kernel, 3, 4))
    inputs, directions = (tuple(rng.standard_normal(size) for size in sizes) for _ in range(2))
    found = derivatives(convolve, inputs, directions, stride)
    expected = derivatives(reference_conv2d, inputs, directions, stride)
    for name, ours, theirs in zip(["value", "gradient", "Hessian-vector product"], found, expected, strict=True):
        jax.tree.map(
            lambda a, b, name=name: np.testing.assert_allclose(
                a, b, rtol=0, atol=1e-10 * np.abs(b).max(), err_msg=name
            ),
            ours,
            theirs,
        )


def test_blocks_in_bfloat16_are_as_exact_as_their_products(rng):
    """Bounds the mean error: products and sums of four of them are rounded to 8 bits."""
    x, kernel = (jnp.asarray(rng.standard_normal(shape)) for shape in ((4, 16, 20, 40), (3, 3, 40, 40)))
    x, kernel = (value.astype(jnp.bfloat16).astype(float) for value in (x, kernel))
    exact = convolution.convolve_blocks(x, kernel, 2)
    rough = convolution.convolve_blocks(x.astype(jnp.bfloat16), kernel.astype(jnp.bfloat16), 2)
    distance = jnp.linalg.norm(rough.astype(float) - exact) / jnp.linalg.norm(exact)
    assert 1e-4 < distance < 2**-8


@pytest.mark.parametrize("filters", [2, 40])
def test_blocks_that_are_put_side_by_side_or_added_give_the_same(rng, filters):
    """Covers both: with 3 channels and stride 2, blocks are put side by side for more than 12 filters."""
    x, kernel = rng.standard_normal((2, 9, 12, 3)), rng.standard_normal((3, 3, 3, filters))
    found = convolution.convolve_blocks(jnp.asarray(x), jnp.asarray(kernel), 2)
    np.testing.assert_allclose(found, reference_conv2d(x, kernel, 2), atol=1e-12)


@pytest.mark.parametrize("convolve", [convolution.convolve_patches, convolution.convolve_blocks])
def test_convolution_with_every_tasks_own_kernel_is_a_loop_of_lax(rng, convolve):
    x, kernel = rng.standard_normal((5, 2, 8, 9, 3)), rng.standard_normal((5, 3, 3, 3, 4))
    found = jax.vmap(lambda x, kernel: convolve(x, kernel, 2))(x, kernel)
    expected = [reference_conv2d(x[i], kernel[i], 2) for i in range(5)]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_gradient_of_a_kernel_that_tasks_share_is_the_sum_over_tasks(rng):
    x, kernel = jnp.asarray(rng.standard_normal((3, 16, 14, 17, 3))), jnp.asarray(rng.standard_normal((3, 3, 3, 4)))

    def gradient(conv):
        return jax.grad(lambda kernel: jnp.sum(jax.vmap(lambda x: conv(x, kernel, 1))(x) ** 3))(kernel)

    assert_agree(gradient(convolution.convolve_blocks), gradient(reference_conv2d), 1e-10)


def test_a_gpu_has_kernels_for_bfloat16_and_few_channels(rng, monkeypatch):
    """Lets the GPU's kernels be interpreted, and tells them from blocks, which know any type and number of channels."""
    calls = []
    interpreted = functools.partial(task_convolution.convolve_directly, interpret=True)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(task_convolution, "convolve_directly", lambda *args: calls.append(args) or interpreted(*args))
    for dtype, channels, kernels in ((jnp.bfloat16, 4, 1), (jnp.bfloat16, 65, 0), (jnp.float32, 4, 0)):
        x, kernel = (jnp.asarray(rng.random(shape), dtype) for shape in ((1, 5, 6, channels), (3, 3, channels, 2)))
        found = convolution.conv2d(x, kernel, 2).astype(float)
        np.testing.assert_allclose(found, reference_conv2d(x.astype(float), kernel.astype(float), 2), rtol=2**-7)
        assert len(calls) == kernels
        calls.clear()
