"""Layers whose weights may differ from task to task."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from milx.meta.convolution import conv2d
from milx.meta.operations import MOST_NUMBERS


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


def biased_norm(x: jax.Array, bias: jax.Array, center: jax.Array) -> jax.Array:
    """Computes layer_norm(x + bias) + center for images [B, H, W, F], in the type of the bias [F]."""
    return layer_norm(x.astype(bias.dtype) + bias) + center


def norm_relu(x: jax.Array, bias: jax.Array, center: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """Computes relu(biased_norm(x, bias, center)) as `dtype`, on a GPU by `channel_norm.normalize`.

    That cannot be differentiated forward alone, and 32 bits must count its numbers.
    """
    if jax.default_backend() == "gpu" and x.size <= MOST_NUMBERS:
        from milx.networks.channel_norm import normalize  # Pallas takes a quarter of a second to import

        return normalize(x, bias, center, dtype)
    return nn.relu(biased_norm(x, bias, center)).astype(dtype)


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
        if skip is None:
            return norm_relu(x, bias, center, dtype)
        return nn.relu(biased_norm(x, bias, center) + skip).astype(dtype)


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
