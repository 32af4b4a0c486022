"""The loss of an inner step that has no actions to imitate, meta-learned so that its gradient points at the task."""

import flax.linen as nn
import jax
import jax.numpy as jnp

from milx.networks.layers import Dense

KINDS = ("linear", "temporal")
_KERNEL, _FILTERS, _UNITS = 10, 32, 32


class LearnedLoss(nn.Module):
    """Maps what the policy makes of demonstrations, [K, T, F], to a loss [K].

    Attributes:
        kind: "linear" is 1 / (T D) sum over t, i of (W y_t + b)_i^2, with D = 32 rows in W (Finn, Yu et al. 2017,
            Section 4.3, where it is the sum). "temporal" puts two convolutions over time with layer norm and ReLU
            before it (Yu et al. 2018, arXiv:1802.01557), so that the order of the time steps matters: adapt to as many
            of them as in training.
    """

    kind: str

    @nn.compact
    def __call__(self, features: jax.Array) -> jax.Array:
        """Computes the loss as the class says."""
        x, dtype = features, features.dtype
        if self.kind == "temporal":
            for _ in range(2):
                x = nn.Conv(_FILTERS, (_KERNEL,), dtype=dtype, param_dtype=dtype)(x)
                x = nn.relu(nn.LayerNorm(dtype=dtype, param_dtype=dtype)(x))
        return jnp.square(Dense(_UNITS)(x)).mean(axis=(1, 2))
