"""Convolutions against `jax.lax`."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lax_convolution import all_derivatives, assert_agree, reference_conv2d

from milx.meta import convolution


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


@pytest.mark.parametrize(("filters", "groups"), [(4, 4), (2, 8)])
def test_kernels_gradients_by_groups_are_those_of_lax(rng, monkeypatch, filters, groups):
    """Compares derivatives of both products of blocks, forward alone and reverse over reverse included."""
    chosen, choose = [], convolution._groups
    monkeypatch.setattr(convolution, "_groups", lambda *shapes: chosen.append(choose(*shapes)) or chosen[-1])
    sizes = ((16, 14, 17, 3), (3, 3, 3, filters))
    inputs, directions = (tuple(jnp.asarray(rng.standard_normal(size)) for size in sizes) for _ in range(2))
    found = all_derivatives(convolution.convolve_blocks, inputs, directions, 1)
    assert set(chosen) == {groups}
    assert_agree(found, all_derivatives(reference_conv2d, inputs, directions, 1), 1e-10)


def test_gradient_of_a_kernel_that_tasks_share_is_the_sum_over_tasks(rng):
    x, kernel = jnp.asarray(rng.standard_normal((3, 16, 14, 17, 3))), jnp.asarray(rng.standard_normal((3, 3, 3, 4)))

    def gradient(conv):
        return jax.grad(lambda kernel: jnp.sum(jax.vmap(lambda x: conv(x, kernel, 1))(x) ** 3))(kernel)

    assert_agree(gradient(convolution.convolve_blocks), gradient(reference_conv2d), 1e-10)


def test_kernels_gradients_by_groups_are_as_exact_as_their_products(rng):
    """Bounds the error of a sum of eight groups' products: they, the sum, and what they are made of have 8 bits."""
    x, kernel = (jnp.asarray(rng.standard_normal(shape)) for shape in ((16, 14, 17, 3), (3, 3, 3, 2)))
    x, kernel = (value.astype(jnp.bfloat16).astype(float) for value in (x, kernel))

    def gradient(x, kernel):
        return jax.grad(lambda kernel: jnp.sum(convolution.convolve_blocks(x, kernel, 1)))(kernel).astype(float)

    exact, rough = gradient(x, kernel), gradient(x.astype(jnp.bfloat16), kernel.astype(jnp.bfloat16))
    distance = jnp.linalg.norm(rough - exact) / jnp.linalg.norm(exact)
    assert 1e-4 < distance < 2**-7


def test_groups_write_at_most_a_sixteenth_of_what_they_read():
    for x, weights in (((100, 17, 17, 256), (256, 256)), ((50, 17, 21, 160), (160, 160)), ((18, 5, 5, 7), (7, 3))):
        groups = convolution._groups(x, weights)
        read = np.prod(x[:-1]) * sum(weights)
        larger = [n for n in range(groups + 1, x[0] + 1) if x[0] % n == 0]
        assert groups > 1 and x[0] % groups == 0 and 16 * groups * np.prod(weights) <= read
        assert all(16 * n * np.prod(weights) > read for n in larger)
    assert convolution._groups((8, 17, 17, 256), (256, 256)) == 1
