"""Bias, layer norm, center and ReLU by a GPU's sums, interpreted, against layers of flax and JAX."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.networks.channel_norm import normalize
from milx.networks.layers import layer_norm


def plainly(x, bias, center):
    return jax.nn.relu(layer_norm(x + bias) + center)


def by_sums(x, bias, center, dtype=float):
    return normalize(x, bias, center, dtype, interpret=True)


@pytest.mark.parametrize("shape", [(2, 3, 4, 5), (3, 1, 1, 7)])
def test_values_and_derivatives_are_those_of_the_layers(rng, shape):
    """Compares the value, the gradient, and its derivative along a direction, for two tasks."""
    shapes = (2, *shape), (2, shape[-1]), (2, shape[-1])
    inputs, directions = (tuple(jnp.asarray(rng.standard_normal(each)) for each in shapes) for _ in range(2))

    def derivatives(function):
        gradient = jax.grad(lambda inputs: jnp.sum(jnp.sin(3 * jax.vmap(function)(*inputs)) ** 2))
        return jax.vmap(function)(*inputs), jax.jvp(gradient, (inputs,), (directions,))

    agree = lambda found, expected: np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)  # noqa: E731
    jax.tree.map(agree, derivatives(by_sums), derivatives(plainly))


def test_gradients_of_bfloat16_images_are_summed_in_float32(rng):
    """With a center of 10 nothing is cut off, and the center's gradient is the number of the pixels, in thirds.

    That is no number of bfloat16, and neither are parts of it.
    """
    x = jnp.asarray(rng.standard_normal((2, 63, 61, 3)), jnp.bfloat16)
    weight = float(jnp.bfloat16(1 / 3))
    loss = lambda center: weight * by_sums(x, jnp.zeros(3), center, jnp.bfloat16).astype(jnp.float32).sum()  # noqa: E731
    found = jax.grad(loss)(jnp.full(3, 10.0))
    np.testing.assert_allclose(found, 2 * 63 * 61 * weight, rtol=1e-6)


def test_a_constant_image_has_the_value_of_the_center_and_finite_gradients():
    """Rounding makes the variance of so large numbers negative in float32, unless it is cut off at zero."""
    x, center = jnp.full((1, 9, 7, 3), 1234.567, jnp.float32), jnp.array([-1.0, 0.0, 2.0], jnp.float32)

    def total(x, center):
        y = by_sums(x, jnp.zeros(3, jnp.float32), center, jnp.float32)
        return y.sum(), y

    (_, y), gradients = jax.value_and_grad(total, argnums=(0, 1), has_aux=True)(x, center)
    off = np.abs(np.asarray(y) - np.maximum(center, 0))
    assert off.max() < 0.5  # the mean is off by 1e-4, which is divided by 1e-3
    assert all(np.isfinite(each).all() for each in gradients)


def test_other_devices_compute_the_same(rng):
    inputs = tuple(jnp.asarray(rng.standard_normal(shape)) for shape in ((2, 3, 4, 5), (5,), (5,)))
    gradients = (
        jax.grad(lambda inputs, by=by: jnp.sum(by(*inputs) ** 2))(inputs)
        for by in (functools.partial(normalize, dtype=float), plainly)
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-10), *gradients)
