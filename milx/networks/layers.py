"""Layers whose weights may differ from task to task.

After adaptation every task has its own kernels, and `vmap` over tasks turns `lax.conv` into a grouped convolution,
which XLA runs badly everywhere. Written as one matrix product, the same convolution becomes a batched matrix product.
"""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp


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


def positions(height: int, width: int) -> jax.Array:
    """Returns x and y in [-1, 1] of every position of a feature map, row by row: [H W, 2]."""
    y, x = jnp.meshgrid(jnp.linspace(-1, 1, height), jnp.linspace(-1, 1, width), indexing="ij")
    return jnp.stack([x.ravel(), y.ravel()], axis=-1)


def spatial_soft_argmax(features: jax.Array, temperature: jax.Array) -> jax.Array:
    """Computes the expected image position of every channel (Levine et al. 2016, Section 5.1).

    Args:
        features: [B, H, W, C].
        temperature: [C], divides the features before the softmax.

    Returns:
        [B, 2 C]: x of all channels, then y, each in [-1, 1].
    """
    height, width, channels = features.shape[1:]
    attention = jax.nn.softmax(features.reshape(-1, height * width, channels) / temperature, axis=1)
    points = [jnp.einsum("bpc,p->bc", attention, axis) for axis in positions(height, width).T]
    return jnp.concatenate(points, axis=-1)


class SpatialSoftArgmax(nn.Module):
    """`spatial_soft_argmax` with a learned temperature for every channel."""

    @nn.compact
    def __call__(self, features: jax.Array) -> jax.Array:
        """Maps [B, H, W, C] to [B, 2 C]."""
        log_temperature = self.param("log_temperature", nn.initializers.zeros, features.shape[-1:])
        return spatial_soft_argmax(features, jnp.exp(log_temperature))


def layer_norm(x: jax.Array) -> jax.Array:
    """Normalizes to zero mean and unit variance over all axes but the first; nothing is learned."""
    axes = tuple(range(1, x.ndim))
    # The variance as flax computes it, from sums that one pass over the input gives.
    mean, square = x.mean(axes, keepdims=True), jnp.square(x).mean(axes, keepdims=True)
    variance = jnp.maximum(square - jnp.square(mean), 0.0)
    return (x - mean) * jax.lax.rsqrt(variance + 1e-6)


@jax.custom_vjp
def add_bias(x: jax.Array, bias: jax.Array) -> jax.Array:
    """Adds a bias [F] to [.., F] in the bias's type, and computes the bias's gradient by `_sum_over_pixels`.

    Like `shifted_relu`, it can be differentiated in reverse, and forward over reverse, but not forward alone.
    """
    return x.astype(bias.dtype) + bias


def _add_bias_forward(x: jax.Array, bias: jax.Array) -> tuple[jax.Array, jax.Array]:
    return x.astype(bias.dtype) + bias, jnp.zeros((), x.dtype)


def _add_bias_backward(like: jax.Array, gradient: jax.Array) -> tuple[jax.Array, jax.Array]:
    rounded = gradient.astype(like.dtype)
    return rounded, _sum_over_pixels(rounded, gradient.dtype)


add_bias.defvjp(_add_bias_forward, _add_bias_backward)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def shifted_relu(x: jax.Array, center: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """Computes relu([.., F] plus [F]) as `dtype`, and the center's gradient by `_sum_over_pixels`."""
    return nn.relu(x + center).astype(dtype)


def _shifted_relu_forward(x: jax.Array, center: jax.Array, dtype: jnp.dtype) -> tuple[jax.Array, tuple]:
    y = nn.relu(x + center).astype(dtype)
    return y, (y, jnp.zeros((), x.dtype))


def _shifted_relu_backward(dtype: jnp.dtype, kept: tuple, gradient: jax.Array) -> tuple[jax.Array, jax.Array]:
    y, like = kept
    passed = jnp.where(y > 0, gradient, 0)
    return passed.astype(like.dtype), _sum_over_pixels(passed, like.dtype)


shifted_relu.defvjp(_shifted_relu_forward, _shifted_relu_backward)


def _sum_over_pixels(x: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """Sums [.., F] to [F]; on accelerators by a product with ones, since XLA's sum is slow for so few channels."""
    flat = x.reshape(-1, x.shape[-1])
    if jax.default_backend() == "cpu":
        return flat.sum(axis=0, dtype=dtype)
    ones = jnp.ones((8, len(flat)), x.dtype)  # of a product with a single row XLA would make that sum again
    return jnp.matmul(ones, flat, precision=jax.lax.Precision.HIGHEST, preferred_element_type=dtype)[0]


class ConvBlock(nn.Module):
    """Convolution, bias, layer norm over (H, W, C), ReLU; before the ReLU something may be added (He et al. 2016).

    Attributes:
        filters: F, output channels.
        kernel: kernel height and width.
        stride: the same in both directions.
        mixed_precision: convolve, and hand on, in bfloat16; the norm is computed in the parameters' type.
    """

    filters: int
    kernel: int
    stride: int
    mixed_precision: bool = False

    @nn.compact
    def __call__(self, x: jax.Array, skip: jax.Array | None = None) -> jax.Array:
        """Maps [B, H, W, C] to [B, ceil(H / stride), ceil(W / stride), F]; adds `skip`, of that shape."""
        shape = (self.kernel, self.kernel, x.shape[-1], self.filters)
        kernel = self.param("kernel", nn.initializers.lecun_normal(), shape)
        bias = self.param("bias", nn.initializers.zeros, (self.filters,))
        center = self.param("centre", nn.initializers.zeros, (self.filters,))
        dtype = jnp.bfloat16 if self.mixed_precision else kernel.dtype
        x = conv2d(x.astype(dtype), kernel.astype(dtype), self.stride)
        x = layer_norm(add_bias(x, bias))
        return shifted_relu(x if skip is None else x + skip, center, dtype)


class FixedConv(nn.Module):
    """Convolution, bias, ReLU that no gradient reaches; zero until `milx.networks.fixed_filters` puts filters in.

    Attributes:
        filters, kernel, stride, mixed_precision: as in `ConvBlock`.
    """

    filters: int
    kernel: int
    stride: int
    mixed_precision: bool = False

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps [B, H, W, 3] to [B, ceil(H / stride), ceil(W / stride), F]."""
        shape = (self.kernel, self.kernel, x.shape[-1], self.filters)
        kernel = jax.lax.stop_gradient(self.param("fixed_kernel", nn.initializers.zeros, shape))
        bias = jax.lax.stop_gradient(self.param("fixed_bias", nn.initializers.zeros, (self.filters,)))
        dtype = jnp.bfloat16 if self.mixed_precision else kernel.dtype
        return nn.relu(conv2d(x.astype(dtype), kernel.astype(dtype), self.stride) + bias.astype(dtype))


class Dense(nn.Module):
    """A fully connected layer, followed by layer norm and ReLU if it is hidden.

    Attributes:
        features: output size.
        hidden: whether a ReLU follows.
        norm: whether layer norm comes before the ReLU.
        init_std: standard deviation of the weights at the start; None for LeCun's.
    """

    features: int
    hidden: bool = False
    norm: bool = False
    init_std: float | None = None

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps [B, D] to [B, features]."""
        init = nn.initializers.lecun_normal() if self.init_std is None else nn.initializers.normal(self.init_std)
        x = x @ self.param("kernel", init, (x.shape[-1], self.features))
        x = x + self.param("bias", nn.initializers.zeros, (self.features,))
        if self.hidden:
            if self.norm:
                x = layer_norm(x) + self.param("centre", nn.initializers.zeros, (self.features,))
            x = nn.relu(x)
        return x
