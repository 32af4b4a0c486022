"""A first convolution that is given and never learned (paper, Section 6.3): VGG-19's, or a bank of the training images.

The bank is a usual one where no pretrained network is at hand (Coates, Ng and Lee 2011): patches of the training
images are normalized and whitened, and the centers of their clusters become filters.
"""

import pathlib
from typing import NamedTuple

import jax
import numpy as np

from milx.config.schema import ConvConfig
from milx.core import pytrees
from milx.core.files import FileError
from milx.types import Params

KMEANS = "kmeans"
"""The value of `ConvConfig.fixed_filters` for a bank of the training images; any other is a file."""
ITERATIONS = 30
MEAN, STD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
"""Of the images that VGG-19 was trained on, by channel."""
_WEIGHT, _BIAS = "features.0.weight", "features.0.bias"
_PATCHES = 100_000


class Filters(NamedTuple):
    """A convolution of images in [0, 1].

    Attributes:
        kernel: [k, k, 3, F].
        bias: [F].
    """

    kernel: np.ndarray
    bias: np.ndarray


def read_filters(path: str, config: ConvConfig) -> Filters:
    """Reads VGG-19's first convolution from a .npz or .safetensors file with torchvision's names.

    The image's normalization becomes part of it. At the border it sees black where VGG-19 sees gray.

    Raises:
        ValueError: for a file of another kind, an array that is missing or of another shape, or layers of another size.
    """
    shape = (config.filters[0], 3, config.kernel, config.kernel)
    file = pathlib.Path(path)
    if file.suffix not in (".npz", ".safetensors"):
        raise ValueError(f"network.fixed_filters: got {path!r}, expected {KMEANS!r} or a .npz or .safetensors file")
    if not file.is_file():
        raise ValueError(f"network.fixed_filters: {path} does not exist")
    try:
        arrays = pytrees.read_tensors(file)
    except FileError as error:
        raise ValueError(f"network.fixed_filters: {error}") from error
    for name, expected in ((_WEIGHT, shape), (_BIAS, shape[:1])):
        if name not in arrays:
            raise ValueError(f"{path}: {name}: missing, expected {expected}; there are {', '.join(sorted(arrays))}")
        if arrays[name].shape != expected:
            raise ValueError(f"{path}: {name}: got {arrays[name].shape}, expected {expected}")
    kernel = arrays[_WEIGHT].astype(float).transpose(2, 3, 1, 0)
    scaled = kernel / STD[:, None]
    bias = arrays[_BIAS] - (scaled * MEAN[:, None]).sum(axis=(0, 1, 2))
    return Filters(scaled.astype(np.float32), bias.astype(np.float32))


def cluster(images: list[np.ndarray], config: ConvConfig) -> Filters:
    """Makes filters of the clusters of the images' patches; the same for the same images.

    Args:
        images: [N, H, W, 3] uint8 of every camera.
        config: how many filters, and their size.
    """
    rng, size, count = np.random.default_rng(0), config.kernel, config.filters[0]
    patches = np.concatenate([_patches(each, size, _PATCHES // len(images), rng) for each in images]) / 255.0
    centered = patches - patches.mean(axis=1, keepdims=True)
    spread = centered.std(axis=1, keepdims=True)
    normal = (centered / np.sqrt(spread**2 + 1e-2))[spread[:, 0] > 1e-3]  # flat patches tell nothing
    mean = normal.mean(axis=0)
    value, vector = np.linalg.eigh(np.cov(normal.T))
    whiten = vector / np.sqrt(value + 0.1) @ vector.T
    white = (normal - mean) @ whiten

    centers = rng.normal(size=(count, white.shape[1]))
    for _ in range(ITERATIONS):
        centers /= np.linalg.norm(centers, axis=1, keepdims=True)
        score = white @ centers.T
        nearest = score.argmax(axis=1)
        centers = np.eye(count)[nearest].T @ (white * score.max(axis=1, keepdims=True))
        empty = np.linalg.norm(centers, axis=1) < 1e-6
        centers[empty] = white[rng.integers(0, len(white), empty.sum())]
    centers /= np.linalg.norm(centers, axis=1, keepdims=True)

    weights = whiten @ centers.T
    weights -= weights.mean(axis=0)  # as every patch is centered
    scale = (centered @ weights).std(axis=0)
    kernel = (weights / scale).reshape(size, size, 3, count)
    return Filters(kernel.astype(np.float32), np.zeros(count, np.float32))


def _patches(images: np.ndarray, size: int, count: int, rng: np.random.Generator) -> np.ndarray:
    """Draws patches [count, size * size * 3] of images [N, H, W, 3]."""
    windows = np.lib.stride_tricks.sliding_window_view(images, (size, size), axis=(1, 2))
    index = [rng.integers(0, n, count) for n in windows.shape[:3]]
    return windows[tuple(index)].transpose(0, 2, 3, 1).reshape(count, -1)


def put(params: Params, filters: Filters) -> Params:
    """Replaces the kernel of every fixed convolution in the parameters by the given filters."""
    values = {"fixed_kernel": filters.kernel, "fixed_bias": filters.bias}

    def replace(path: tuple, leaf: jax.Array) -> jax.Array:
        name = getattr(path[-1], "key", None)
        return jax.numpy.asarray(values[name], leaf.dtype) if name in values and leaf.ndim else leaf

    return jax.tree_util.tree_map_with_path(replace, params)
