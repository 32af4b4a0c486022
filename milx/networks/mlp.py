"""A multilayer perceptron for networks that see states and no images."""

import flax.linen as nn
import jax


class MLP(nn.Module):
    """Three hidden layers with swish, and a linear one whose outputs are small at first.

    Attributes:
        outputs: number of outputs.
        width: units of each hidden layer.
    """

    outputs: int
    width: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps [..., Z] to [..., outputs]."""
        for _ in range(3):
            x = nn.swish(nn.Dense(self.width)(x))
        small = nn.initializers.variance_scaling(1e-4, "fan_in", "truncated_normal")
        return nn.Dense(self.outputs, kernel_init=small)(x)
