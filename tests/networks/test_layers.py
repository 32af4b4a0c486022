"""Layers against `jax.lax`, closed forms and their laws."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.config.schema import ConvConfig
from milx.meta import task_convolution
from milx.networks import channel_norm, layers
from milx.networks.policy_network import ConvStack

# Convolution.


@pytest.mark.parametrize("stride", [1, 2])
def test_the_layer_is_that_of_flax(rng, stride):
    x = rng.standard_normal((2, 9, 12, 3))
    theirs, ours = nn.Conv(5, (3, 3), stride), layers.Conv(5, 3, stride)
    params = theirs.init(jax.random.key(0), x)
    params["params"]["bias"] = jnp.asarray(rng.standard_normal(5))
    np.testing.assert_allclose(ours.apply(params, x), theirs.apply(params, x), atol=1e-6)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a.shape, b.shape), ours.init(jax.random.key(0), x), params)


# Spatial soft-argmax.


def test_soft_argmax_of_a_sharp_peak_is_its_position():
    height, width = 5, 7
    for i, j in [(0, 0), (4, 6), (1, 5), (2, 3)]:
        features = np.zeros((1, height, width, 2))
        features[0, i, j, 0] = 50.0
        features[0, height - 1 - i, width - 1 - j, 1] = 50.0
        x, y = -1 + 2 * j / (width - 1), -1 + 2 * i / (height - 1)
        found = layers.spatial_soft_argmax(jnp.asarray(features), jnp.ones(2))
        # The 34 other pixels together have weight 34 exp(-50).
        np.testing.assert_allclose(found, [[x, -x, y, -y]], atol=1e-12)


def test_soft_argmax_of_a_uniform_image_is_the_middle():
    features = np.broadcast_to([3.0, -1.0, 0.0], (2, 6, 9, 3))
    np.testing.assert_allclose(layers.spatial_soft_argmax(jnp.asarray(features), jnp.ones(3)), 0, atol=1e-15)


def test_soft_argmax_moves_with_the_image(rng):
    """Moves a blob on a zero image, where exp(0) is negligible, by a pixel: 2 / (size - 1) further."""
    height, width = 12, 14
    features = np.zeros((1, height, width, 4))
    features[0, 3:7, 2:6] = rng.uniform(60, 63, (4, 4, 4))
    moved = np.roll(features, (4, 6), axis=(1, 2))
    before, after = (layers.spatial_soft_argmax(jnp.asarray(f), jnp.ones(4)) for f in (features, moved))
    shift = np.repeat([6 * 2 / (width - 1), 4 * 2 / (height - 1)], 4)
    np.testing.assert_allclose(after - before, shift[None], atol=1e-12)
    assert np.ptp(before[0, :4]) > 0.01, "the blobs of the channels differ"


def test_soft_argmax_divides_by_the_temperature_of_each_channel(rng):
    features, temperature = rng.standard_normal((2, 5, 6, 3)), np.array([0.1, 1.0, 7.0])
    found = layers.spatial_soft_argmax(jnp.asarray(features), jnp.asarray(temperature))
    weights = np.exp(features / temperature)
    weights /= weights.sum(axis=(1, 2), keepdims=True)
    x = np.einsum("bhwc,w->bc", weights, np.linspace(-1, 1, 6))
    y = np.einsum("bhwc,h->bc", weights, np.linspace(-1, 1, 5))
    np.testing.assert_allclose(found, np.concatenate([x, y], axis=-1), atol=1e-12)


# Layer norm.


@pytest.mark.parametrize("shape", [(3, 4, 5, 6), (3, 20)])
def test_layer_norm_has_zero_mean_and_unit_variance(rng, shape):
    scale = np.array([0.5, 10.0, 300.0]).reshape(-1, *[1] * (len(shape) - 1))
    x, axes = scale * (rng.standard_normal(shape) + 3), tuple(range(1, len(shape)))
    found = np.asarray(layers.layer_norm(jnp.asarray(x)))
    np.testing.assert_allclose(found.mean(axes), 0, atol=1e-12)
    # 1e-6 is added to the variance.
    variance = x.var(axes)
    np.testing.assert_allclose(found.var(axes), variance / (variance + 1e-6), rtol=1e-12)
    # It is an increasing affine map of each example.
    np.testing.assert_allclose(
        found * np.sqrt(x.var(axes, keepdims=True) + 1e-6), x - x.mean(axes, keepdims=True), atol=1e-9
    )


def test_layer_norm_of_a_constant_image_is_zero_and_has_finite_gradients():
    cubed = jax.jit(jax.value_and_grad(lambda x: jnp.sum((1 + layers.layer_norm(x)) ** 3)))
    found, gradient = cubed(np.full((2, 3, 4), 7.0))
    assert found == pytest.approx(2 * 3 * 4)
    assert np.isfinite(gradient).all()


def test_residual_blocks_add_two_convolutions_to_their_input(rng):
    """Compares with lax's convolutions and NumPy's norm, written out."""
    config = ConvConfig(filters=(4,), strides=(2,), residual_blocks=2)
    image = rng.integers(0, 256, (3, 8, 6, 3), dtype=np.uint8)
    stack = ConvStack(config)
    drawn = stack.init(jax.random.key(0), image, jnp.float64)["params"]
    params = jax.tree.map(lambda x: x + 0.3 * rng.standard_normal(x.shape), drawn)

    def normalized(x, name, stride=1):
        x = (
            np.asarray(
                jax.lax.conv_general_dilated(
                    x, params[name]["kernel"], (stride, stride), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
                )
            )
            + params[name]["bias"]
        )
        deviation = x - x.mean((1, 2, 3), keepdims=True)
        return deviation / np.sqrt(x.var((1, 2, 3), keepdims=True) + 1e-6) + params[name]["centre"]

    x = np.maximum(normalized(image / 255.0, "ConvBlock_0", 2), 0)
    for j in range(2):
        inside = np.maximum(normalized(x, f"Residual_0_{j}_0"), 0)
        x = np.maximum(x + normalized(inside, f"Residual_0_{j}_1"), 0)
    np.testing.assert_allclose(stack.apply({"params": params}, image, jnp.float64), x, rtol=1e-9, atol=1e-12)
    assert len(params) == 5


# On a GPU.


@pytest.mark.parametrize("skips", [False, True])
def test_a_block_by_kernels_of_a_gpu_is_that_of_a_cpu(rng, monkeypatch, skips):
    """Compares value and gradients in bfloat16."""
    block = layers.ConvBlock(4, 3, 2, mixed_precision=True)
    x, weights, skip = (jnp.asarray(rng.random(shape), jnp.float32) for shape in ((2, 9, 10, 3), *[(2, 5, 5, 4)] * 2))
    skip = skip if skips else None
    params = jax.tree.map(lambda p: p + 0.1 * rng.standard_normal(p.shape), block.init(jax.random.key(0), x))

    def derivatives():
        loss = lambda params: jnp.sum(weights * block.apply(params, x, skip))  # noqa: E731
        return jax.value_and_grad(loss)(params)

    expected, calls = derivatives(), []
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    for module, name in ((task_convolution, "convolve_directly"), (channel_norm, "normalize")):
        interpreted = functools.partial(getattr(module, name), interpret=True)
        monkeypatch.setattr(module, name, lambda *args, of=name, by=interpreted: calls.append(of) or by(*args))
    for found, wanted in zip(jax.tree.leaves(derivatives()), jax.tree.leaves(expected), strict=True):
        assert found.dtype == wanted.dtype
        np.testing.assert_allclose(found, wanted, rtol=0, atol=2**-6 * np.abs(wanted).max())
    assert calls == ["convolve_directly"] + ([] if skips else ["normalize"])


def test_more_numbers_than_32_bits_count_are_normalized_plainly(rng, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(layers, "MOST_NUMBERS", 100)
    monkeypatch.setattr(channel_norm, "normalize", None)
    x, bias, center = (jnp.asarray(rng.standard_normal(shape)) for shape in ((2, 5, 6, 4), (4,), (4,)))
    expected = jax.nn.relu(layers.layer_norm(x + bias) + center)
    np.testing.assert_allclose(layers.norm_relu(x, bias, center, float), expected, atol=1e-12)
