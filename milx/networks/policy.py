"""The policy network of the paper: convolutions, then fully connected layers that also see the robot's state."""

from collections.abc import Callable
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from milx.config import NetworkConfig
from milx.networks.goal import Goal, GoalHead
from milx.networks.layers import ConvBlock, Dense, spatial_soft_argmax
from milx.types import Params


class PolicyOutput(NamedTuple):
    """What the network says of a batch of observations.

    Attributes:
        action: [B, A] of the head that acts, in the network's units.
        inner_action: [B, A] of the head that the inner loss sees; the same head if there is only one.
        goal: where the episode will end; None without a goal head.
    """

    action: jax.Array
    inner_action: jax.Array
    goal: Goal | None


class PolicyNetwork(NamedTuple):
    """The network as a pair of pure functions.

    Attributes:
        init: key -> params.
        apply: (params, image [B, H, W, 3] uint8, whitened state [B, S]) -> PolicyOutput.
    """

    init: Callable[[jax.Array], Params]
    apply: Callable[[Params, jax.Array, jax.Array], PolicyOutput]


class _Policy(nn.Module):
    config: NetworkConfig
    action_size: int
    goal_size: int

    @nn.compact
    def __call__(self, image: jax.Array, state: jax.Array) -> PolicyOutput:
        config = self.config
        x = image.astype(state.dtype) / 255.0
        block = nn.remat(ConvBlock) if config.rematerialise else ConvBlock
        for i, (filters, stride) in enumerate(zip(config.filters, config.strides, strict=True)):
            x = block(filters, config.kernel, stride, config.mixed_precision, name=f"ConvBlock_{i}")(x)
        x = x.astype(state.dtype)
        goal = GoalHead(self.goal_size, name="goal_head")(x) if config.goal_head else None
        if config.soft_argmax:
            x = spatial_soft_argmax(x, jnp.exp(self.param("log_temperature", nn.initializers.zeros, x.shape[-1:])))
        else:
            x = x.reshape(len(x), -1)

        # A learned constant joins the input of the first layer: its gradient gives the layer's bias a step of its own
        # (the paper's bias transformation, Section 4.1).
        z = self.param("bias_transformation", nn.initializers.zeros, (config.bias_transformation,))
        parts = [x, state, jnp.broadcast_to(z, (len(x), *z.shape))]
        if goal is not None:
            parts.append(goal.mean)
        x = jnp.concatenate(parts, axis=-1)
        for features in config.fc_layers:
            x = Dense(features, hidden=True, norm=config.fc_norm, init_std=config.fc_init_std)(x)
        heads = [Dense(self.action_size, init_std=config.fc_init_std)(x) for _ in range(config.heads)]
        return PolicyOutput(action=heads[-1], inner_action=heads[0], goal=goal)


def make_policy(
    config: NetworkConfig, image_shape: tuple[int, int], state_size: int, action_size: int, goal_size: int
) -> PolicyNetwork:
    """Builds the policy network.

    Args:
        config: layers and heads.
        image_shape: (H, W).
        state_size: S.
        action_size: A.
        goal_size: G, entries of the state that the goal head predicts.
    """
    module = _Policy(config, action_size, goal_size)

    def init(key: jax.Array) -> Params:
        return module.init(key, jnp.zeros((1, *image_shape, 3), jnp.uint8), jnp.zeros((1, state_size)))["params"]

    def apply(params: Params, image: jax.Array, state: jax.Array) -> PolicyOutput:
        output = module.apply({"params": params}, image, state)
        assert isinstance(output, PolicyOutput)
        return output

    return PolicyNetwork(init, apply)
