"""Layers whose weights may differ from task to task."""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp

from milx.meta.convolution import conv2d, has_kernels, same_padding


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


def with_bias(x: jax.Array, kernel: jax.Array, bias: jax.Array, stride: int) -> tuple[jax.Array, jax.Array]:
    """Makes a convolution's bias the weight of one more channel, which is one in every pixel.

    It has this weight at the tap that sees a pixel of the image for every output, and none at the others.

    Args:
        x: [B, H, W, C].
        kernel: [k, k, C, F].
        bias: [F].
        stride: the same in both directions.

    Returns:
        [B, H, W, C + 1] and [k, k, C + 1, F], in the types of x and of the kernel.
    """
    taps = kernel.shape[0]
    sees = [same_padding(size, taps, stride)[0] for size in x.shape[1:3]]
    at = [(tap, taps - 1 - tap) for tap in sees]
    weights = jnp.pad(bias.astype(kernel.dtype)[None, None, None], (*at, (0, 0), (0, 0)))
    ones = jnp.pad(x, ((0, 0), (0, 0), (0, 0), (0, 1)), constant_values=1)
    return ones, jnp.concatenate([kernel, weights], axis=2)


def _sum_over_pixels(x: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """Sums [B, .., F] to [F] of a type; a GPU sums in float32, or in float64 if x is."""
    if jax.default_backend() != "gpu":
        return x.reshape(-1, x.shape[-1]).sum(axis=0, dtype=dtype)
    from milx.meta.pixel_sums import sum_over_pixels  # Pallas takes a quarter of a second to import

    return sum_over_pixels(x).astype(dtype)


class Conv(nn.Module):
    """`flax.linen.Conv` with a square kernel, SAME padding and a bias, computed by `conv2d`; its parameters fit.

    Attributes:
        features: F, output channels.
        kernel: k, kernel height and width.
        stride: the same in both directions.
    """

    features: int
    kernel: int
    stride: int = 1

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps [B, H, W, C] to [B, ceil(H / stride), ceil(W / stride), F]."""
        shape = (self.kernel, self.kernel, x.shape[-1], self.features)
        kernel = self.param("kernel", nn.initializers.lecun_normal(), shape)
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        return conv2d(x, kernel, self.stride) + bias


class ConvBlock(nn.Module):
    """Convolution, bias, layer norm over (H, W, C), ReLU; before the ReLU something may be added (He et al. 2016).

    Attributes:
        filters: F, output channels.
        kernel: kernel height and width.
        stride: the same in both directions.
        mixed_precision: convolve, and hand on, in bfloat16; the norm is computed in the parameters' type. A GPU rounds
            the bias for images of three colors, too.
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
        x, kernel = x.astype(dtype), kernel.astype(dtype)
        if has_kernels(x, kernel) and x.shape[-1] == 3:  # they read a fourth channel anyway
            x = conv2d(*with_bias(x, kernel, bias, self.stride), self.stride).astype(bias.dtype)
        else:
            x = add_bias(conv2d(x, kernel, self.stride), bias)
        x = layer_norm(x)
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
