"""Layers whose weights may differ from task to task.

After adaptation every task has its own kernels, and `vmap` over tasks turns `lax.conv` into a grouped convolution,
which XLA runs badly everywhere. Written as strided slices and one matrix product, the same convolution becomes a
batched matrix product.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp


def same_padding(size: int, kernel: int, stride: int) -> tuple[int, int]:
    """Zeros before and after an axis so that the output has ceil(size / stride) entries (TensorFlow's SAME)."""
    total = max((-(-size // stride) - 1) * stride + kernel - size, 0)
    return total // 2, total - total // 2


def patches(x: jax.Array, kernel: int, stride: int) -> jax.Array:
    """Every kernel-sized window of an image, SAME padding.

    Args:
        x: [B, H, W, C].
        kernel: window height and width.
        stride: step between windows.

    Returns:
        [B, ceil(H / stride), ceil(W / stride), kernel * kernel * C], ordered as a [kernel, kernel, C, F] kernel is.
    """
    height, width = x.shape[1:3]
    pads = [same_padding(size, kernel, stride) for size in (height, width)]
    x = jnp.pad(x, ((0, 0), *pads, (0, 0)))
    rows, cols = -(-height // stride), -(-width // stride)
    slices = [
        x[:, i : i + (rows - 1) * stride + 1 : stride, j : j + (cols - 1) * stride + 1 : stride]
        for i in range(kernel)
        for j in range(kernel)
    ]
    return jnp.concatenate(slices, axis=-1)


def conv2d(x: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    """Two-dimensional convolution with SAME padding, as slices and one matrix product.

    Args:
        x: [B, H, W, C].
        kernel: [k, k, C, F].
        stride: the same in both directions.

    Returns:
        [B, ceil(H / stride), ceil(W / stride), F].
    """
    return patches(x, kernel.shape[0], stride) @ kernel.reshape(-1, kernel.shape[-1])


def spatial_soft_argmax(features: jax.Array, temperature: jax.Array) -> jax.Array:
    """Expected image position of every channel (Levine et al. 2016, Section 5.1).

    Args:
        features: [B, H, W, C].
        temperature: [C], divides the features before the softmax.

    Returns:
        [B, 2 C]: x of all channels, then y, each in [-1, 1].
    """
    height, width, channels = features.shape[1:]
    attention = jax.nn.softmax(features.reshape(-1, height * width, channels) / temperature, axis=1)
    y, x = jnp.meshgrid(jnp.linspace(-1, 1, height), jnp.linspace(-1, 1, width), indexing="ij")
    points = [jnp.einsum("bpc,p->bc", attention, axis.ravel()) for axis in (x, y)]
    return jnp.concatenate(points, axis=-1)


def centred_layer_norm(x: jax.Array, bias: jax.Array) -> jax.Array:
    """Layer normalisation over all axes but the first, with a learned centre and no learned scale."""
    axes = tuple(range(1, x.ndim))
    mean = x.mean(axes, keepdims=True)
    variance = jnp.square(x - mean).mean(axes, keepdims=True)
    return (x - mean) * jax.lax.rsqrt(variance + 1e-6) + bias


class ConvBlock(nn.Module):
    """Convolution, bias, layer norm over (H, W, C), ReLU.

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
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps [B, H, W, C] to [B, ceil(H / stride), ceil(W / stride), F]."""
        shape = (self.kernel, self.kernel, x.shape[-1], self.filters)
        kernel = self.param("kernel", nn.initializers.lecun_normal(), shape)
        bias = self.param("bias", nn.initializers.zeros, (self.filters,))
        centre = self.param("centre", nn.initializers.zeros, (self.filters,))
        dtype = jnp.bfloat16 if self.mixed_precision else kernel.dtype
        x = conv2d(x.astype(dtype), kernel.astype(dtype), self.stride)
        return nn.relu(centred_layer_norm(x.astype(bias.dtype) + bias, centre)).astype(dtype)


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
                x = centred_layer_norm(x, self.param("centre", nn.initializers.zeros, (self.features,)))
            x = nn.relu(x)
        return x
