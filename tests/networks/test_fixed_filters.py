"""The first convolution that is given: VGG-19's, or a bank of the training images."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from safetensors.numpy import save_file

from milx.methods.mil import MIL, MILConfig
from milx.methods.whitening import Whitening
from milx.networks import fixed_filters
from milx.networks.policy_network import PolicyConfig, make_policy
from milx.types import Demo, TaskBatch

CONFIG = PolicyConfig(filters=(6, 4), strides=(2, 1), fixed_filters="kmeans", soft_argmax=True, fc_layers=(8,))
RNG = np.random.default_rng(0)
WEIGHT, BIAS = RNG.normal(size=(6, 3, 3, 3)).astype(np.float32), RNG.normal(size=6).astype(np.float32)


def write(path, weight=WEIGHT, **more):
    arrays = {"features.0.weight": weight, "features.0.bias": BIAS, **more}
    if path.suffix == ".npz":
        np.savez(path, **arrays)
    else:
        save_file(arrays, path)
    return str(path)


@pytest.mark.parametrize("kind", ["npz", "safetensors"])
def test_vggs_layer_sees_the_normalized_image(kind, tmp_path):
    """Compares with SciPy's correlation of the image as VGG-19 expects it, away from the border."""
    filters = fixed_filters.read_filters(write(tmp_path / f"vgg.{kind}", other=np.zeros(2)), CONFIG)
    image = RNG.uniform(size=(12, 14, 3))
    normal = (image - fixed_filters.MEAN) / fixed_filters.STD
    for i in range(6):
        expected = BIAS[i] + sum(scipy.signal.correlate2d(normal[..., c], WEIGHT[i, c], "valid") for c in range(3))
        kernel = filters.kernel[..., i]
        found = filters.bias[i] + sum(
            scipy.signal.correlate2d(image[..., c], kernel[..., c], "valid") for c in range(3)
        )
        np.testing.assert_allclose(found, expected, atol=1e-4)


def test_files_that_hold_something_else_are_refused(tmp_path):
    for path, message in (
        ("vgg.pth", r"fixed_filters: got 'vgg.pth', expected 'kmeans' or a .npz or .safetensors file"),
        (str(tmp_path / "none.npz"), "none.npz does not exist"),
        (write(tmp_path / "wide.npz", WEIGHT[:4]), r"features.0.weight: got \(4, 3, 3, 3\), expected \(6, 3, 3, 3\)"),
    ):
        with pytest.raises(ValueError, match=message):
            fixed_filters.read_filters(path, CONFIG)
    np.savez(tmp_path / "other.npz", weight=WEIGHT)
    with pytest.raises(ValueError, match=r"features.0.weight: missing, .* there are weight"):
        fixed_filters.read_filters(str(tmp_path / "other.npz"), CONFIG)


def scene(seed):
    """Draws images with vertical edges and red spots."""
    rng = np.random.default_rng(seed)
    images = np.full((20, 24, 24, 3), 60, np.uint8)
    images[:, :, 12:] = 200
    for image in images:
        y, x = rng.integers(2, 20, 2)
        image[y : y + 3, x : x + 3] = (230, 20, 20)
    return images


def test_the_bank_answers_to_what_the_images_show_and_not_to_brightness():
    config = dataclasses.replace(CONFIG, filters=(12, 4))
    filters = fixed_filters.cluster([scene(0)], config)
    assert np.abs(filters.kernel.sum(axis=(0, 1, 2))).max() < 1e-4  # a flat gray patch gives nothing
    windows = np.lib.stride_tricks.sliding_window_view(scene(1) / 255.0, (3, 3), axis=(1, 2))
    windows = windows[:, :22, :22].transpose(0, 1, 2, 4, 5, 3).reshape(-1, 27)
    answers = windows @ filters.kernel.reshape(27, -1)
    # On images like those it was made from every filter has about unit variance, as on the patches it was made from.
    flat = windows.std(axis=1) < 1e-3
    assert flat.mean() > 0.5
    np.testing.assert_allclose(answers[flat], 0, atol=1e-4)
    assert (answers[~flat].std(axis=0) > 0.2).all()
    # No two are alike.
    kernel = filters.kernel.reshape(27, -1) / np.linalg.norm(filters.kernel.reshape(27, -1), axis=0)
    assert (kernel.T @ kernel - np.eye(12)).max() < 0.999
    again = fixed_filters.cluster([scene(0)], config)
    np.testing.assert_array_equal(filters.kernel, again.kernel)


@pytest.mark.slow
def test_no_gradient_reaches_the_fixed_layer_and_adaptation_leaves_it():
    policy = make_policy(CONFIG, (12, 16), 3, 2, goal_size=0)
    method = MIL(MILConfig(inner_lr=0.1, learn_inner_lr=True), policy)
    whitening = Whitening(jnp.zeros(3), jnp.ones(3), jnp.zeros(2), jnp.ones(2))
    params = jax.jit(method.init)(jax.random.key(0), whitening)
    bank = fixed_filters.Filters(RNG.normal(size=(3, 3, 3, 6)).astype(np.float32), BIAS)
    params = fixed_filters.put(params, bank)
    layer = params["policy"]["vision"]["ConvBlock_0"]
    np.testing.assert_array_equal(layer["fixed_kernel"], bank.kernel)
    np.testing.assert_array_equal(layer["fixed_bias"], bank.bias)

    demo = Demo(
        image=jnp.asarray(RNG.integers(0, 255, (1, 4, 12, 16, 3)), jnp.uint8),
        state=jnp.asarray(RNG.normal(size=(1, 4, 3)), jnp.float32),
        action=jnp.asarray(RNG.normal(size=(1, 4, 2)), jnp.float32),
    )
    adapted = jax.jit(method.adapt)(params, demo)["policy"]
    np.testing.assert_array_equal(adapted["vision"]["ConvBlock_0"]["fixed_kernel"], bank.kernel)
    assert (
        np.abs(adapted["vision"]["ConvBlock_1"]["kernel"] - params["policy"]["vision"]["ConvBlock_1"]["kernel"]).max()
        > 0
    )
    batch = TaskBatch(support=jax.tree.map(lambda x: x[None], demo), query=jax.tree.map(lambda x: x[None], demo))
    gradient = jax.jit(jax.grad(lambda params: method.loss(params, batch)[0]))(params)["policy"]["vision"]
    assert np.abs(gradient["ConvBlock_0"]["fixed_kernel"]).max() == 0
    assert np.abs(gradient["ConvBlock_1"]["kernel"]).max() > 0
