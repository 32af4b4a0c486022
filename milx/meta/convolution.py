"""Convolutions that stay fast where every task has kernels of its own.

After adaptation every task has its own kernels, and `vmap` over tasks turns `lax.conv` into a grouped convolution,
which XLA runs badly on CPUs and, depending on its size, on GPUs. Written as one matrix product, the same convolution
becomes a batched matrix product.
"""

import functools
import math

import jax
import jax.numpy as jnp

MOST_CHANNELS = 64
"""Most channels and filters of the Pallas kernels, whose programs keep sums for all of them."""


def same_padding(size: int, kernel: int, stride: int) -> tuple[int, int]:
    """Computes the zeros before and after an axis for ceil(size / stride) outputs (TensorFlow's SAME)."""
    total = max((-(-size // stride) - 1) * stride + kernel - size, 0)
    return total // 2, total - total // 2


def conv2d(x: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    """Convolves in two dimensions with SAME padding.

    By patches on a CPU, by Pallas kernels on a GPU in bfloat16 with up to 64 channels and filters, and else by blocks.

    Args:
        x: [B, H, W, C].
        kernel: [k, k, C, F].
        stride: the same in both directions.

    Returns:
        [B, ceil(H / stride), ceil(W / stride), F].
    """
    if _has_kernels(x, kernel):
        from milx.meta.task_convolution import convolve_directly  # Pallas takes a quarter of a second to import

        return convolve_directly(x, kernel, stride)
    by = convolve_patches if jax.default_backend() == "cpu" else convolve_blocks
    return by(x, kernel, stride)


def _has_kernels(x: jax.Array, kernel: jax.Array) -> bool:
    """Tells whether `conv2d` convolves by Pallas kernels: on a GPU, in bfloat16, and for sizes that they can have."""
    few = max(kernel.shape[2:]) <= MOST_CHANNELS and math.prod(x.shape[:3]) * max(*kernel.shape[2:], 4) < 2**30
    return jax.default_backend() == "gpu" and jnp.result_type(x, kernel) == jnp.bfloat16 and few


def convolve_patches(x: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    """Computes `conv2d` with the fewest multiplications: copies every window, then multiplies it by the kernel."""
    taps, _, _, filters = kernel.shape
    height, width = x.shape[1:3]
    x = jnp.pad(x, ((0, 0), *(same_padding(size, taps, stride) for size in (height, width)), (0, 0)))
    rows, cols = ((-(-size // stride) - 1) * stride + 1 for size in (height, width))
    shifted = [x[:, i : i + rows : stride, j : j + cols : stride] for i in range(taps) for j in range(taps)]
    patches = jnp.concatenate(shifted, axis=-1)
    return _product(patches, kernel.reshape(-1, filters))


def _product(x: jax.Array, weights: jax.Array) -> jax.Array:
    """Multiplies [.., K] by [K, F] as plain matrices: with more axes XLA also copies the output's gradient."""
    return (x.reshape(-1, x.shape[-1]) @ weights).reshape(*x.shape[:-1], -1)


def convolve_blocks(x: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    """Computes `conv2d` with little traffic to memory and large matrix products.

    The image is cut into blocks just large enough that a tile of outputs depends on 2 x 2 neighboring blocks, and the
    kernel is spread over these four. Either the four are put side by side and multiplied at once, or each block is
    multiplied by the weights of all four places and the products of neighbors are added: whichever moves less memory.
    """
    taps, _, channels, filters = kernel.shape
    batch, *sizes, _ = x.shape
    tile = max(1, -(-(taps - stride) // stride))
    step = tile * stride
    rows, cols = (-(-size // step) for size in sizes)

    pads = []
    for size, count in zip(sizes, (rows, cols), strict=True):
        before, _ = same_padding(size, taps, stride)
        pads.append((before, (count + 1) * step - size - before))
    blocks = jnp.pad(x, ((0, 0), *pads, (0, 0))).reshape(batch, rows + 1, step, cols + 1, step, channels)
    blocks = blocks.swapaxes(2, 3).reshape(batch, rows + 1, cols + 1, step * step * channels)

    weights = _four_places(kernel, stride, tile)
    places = [(i, j) for i in range(2) for j in range(2)]
    if step * step * channels < tile * tile * filters:
        neighbors = [blocks[:, i : i + rows, j : j + cols] for i, j in places]
        y = _product(jnp.concatenate(neighbors, axis=-1), weights.reshape(-1, tile * tile * filters))
    else:
        products = jnp.split(_product(blocks, jnp.concatenate(list(weights), axis=-1)), len(places), axis=-1)
        shifted = [z[:, i : i + rows, j : j + cols] for z, (i, j) in zip(products, places, strict=True)]
        y = functools.reduce(jnp.add, shifted)

    y = y.reshape(batch, rows, cols, tile, tile, filters).swapaxes(2, 3)
    y = y.reshape(batch, rows * tile, cols * tile, filters)
    return y[:, : -(-sizes[0] // stride), : -(-sizes[1] // stride)]


def _four_places(kernel: jax.Array, stride: int, tile: int) -> jax.Array:
    """Computes what blocks in 2 x 2 positions add to a tile of outputs: four maps [step² C, tile² F]."""
    taps, _, channels, filters = kernel.shape
    step = tile * stride

    def placed(i: int, j: int) -> jax.Array:
        pads = [(at * stride, 2 * step - taps - at * stride) for at in (i, j)]
        return jnp.pad(kernel, (*pads, (0, 0), (0, 0)))

    maps = jnp.stack([placed(i, j) for i in range(tile) for j in range(tile)], axis=3)
    maps = maps.reshape(2, step, 2, step, channels, tile * tile * filters).swapaxes(1, 2)
    return maps.reshape(4, step * step * channels, tile * tile * filters)
