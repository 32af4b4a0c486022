"""Convolutions that stay fast where every task has kernels of its own.

After adaptation every task has its own kernels, and `vmap` over tasks turns `lax.conv` into a grouped convolution,
which XLA runs badly on CPUs and, depending on its size, on GPUs. Written as one matrix product, the same convolution
becomes a batched matrix product.
"""

import functools
import math

import jax
import jax.numpy as jnp
from jax.custom_derivatives import SymbolicZero

MANY_IMAGES = 16
"""With so many images of a task or more, sums over images are split or done first.

Presets draw at most eight time steps of a demonstration, or take all; in between the number has not been tuned.
"""


def same_padding(size: int, kernel: int, stride: int) -> tuple[int, int]:
    """Computes the zeros before and after an axis for ceil(size / stride) outputs (TensorFlow's SAME)."""
    total = max((-(-size // stride) - 1) * stride + kernel - size, 0)
    return total // 2, total - total // 2


def conv2d(x: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    """Convolves in two dimensions with SAME padding: on a CPU by patches, on accelerators by blocks.

    Args:
        x: [B, H, W, C].
        kernel: [k, k, C, F].
        stride: the same in both directions.

    Returns:
        [B, ceil(H / stride), ceil(W / stride), F].
    """
    by = convolve_patches if jax.default_backend() == "cpu" else convolve_blocks
    return by(x, kernel, stride)


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


@jax.custom_jvp
def _product_by_groups(x: jax.Array, weights: jax.Array) -> jax.Array:
    """Computes `_product` of [B, .., K] and [K, F], whose derivative x dW is one product for each group of images.

    Its transpose, the gradient by W, is then a sum of several smaller products, which together keep all of a GPU busy.
    XLA would split the product as well, but first copies x and the output's gradient to fill up their rows.
    """
    return _product(x, weights)


@functools.partial(_product_by_groups.defjvp, symbolic_zeros=True)
def _product_by_groups_jvp(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    """Computes x W, and dx W + x dW."""
    (x, weights), (dx, dweights) = primals, tangents
    y = _product_by_groups(x, weights)
    dy = jnp.zeros_like(y)
    if not isinstance(dx, SymbolicZero):
        dy += _product_by_groups(dx, weights)
    if isinstance(dweights, SymbolicZero):
        return y, dy
    if (groups := _groups(x.shape, weights.shape)) == 1:
        return y, dy + _product(x, dweights)
    rows = x.reshape(groups, -1, x.shape[-1])
    # The copies depend on x, so that `vmap` over tasks makes some for every task even where tasks share the weights:
    # otherwise XLA reorders x, to multiply the same group of all tasks at once.
    copies = dweights * (1 + 0 * rows[:, :1, :1])
    # Without the barrier XLA computes the output's gradient once for each of the two products that read it.
    return y, jax.lax.optimization_barrier(dy + (rows @ copies).reshape(y.shape))


def _groups(x: tuple[int, ...], weights: tuple[int, int]) -> int:
    """Chooses the most groups of B images that leave each at least 16 K F / (K + F) rows; one group of few images.

    What their products write, K F numbers each, is then at most a sixteenth of what they read, K + F numbers a row.
    Batches of few images of a task have many tasks, which keep a GPU busy without groups.
    """
    inputs, outputs = weights
    least = 16 * inputs * outputs / (inputs + outputs)
    rows = math.prod(x[:-1])
    most = x[0] if x[0] >= MANY_IMAGES else 1
    return max(n for n in range(1, most + 1) if n == 1 or (x[0] % n == 0 and rows >= n * least))


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
        y = _product_by_groups(jnp.concatenate(neighbors, axis=-1), weights.reshape(-1, tile * tile * filters))
    else:
        products = jnp.split(_product_by_groups(blocks, jnp.concatenate(list(weights), axis=-1)), len(places), axis=-1)
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
