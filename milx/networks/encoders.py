"""Policies that turn a demonstration into a vector once, and see that vector while they act (paper, Section 6).

*Contextual*: the vector comes from the demonstration's last frame. *LSTM*: a recurrent network reads frames from the
first to the last, with states and actions. The network that acts is the same for both, and MIL's but for the vector.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from milx.config.schema import LARGEST_SIZE, VisionConfig, number
from milx.networks.goal import StateGoalHead
from milx.networks.layers import Dense
from milx.networks.policy_network import Controller, PolicyOutput, listed, see
from milx.types import Params, Spec, black


@dataclasses.dataclass
class ContextConfig(VisionConfig):
    """The networks of a method without adaptation.

    Attributes:
        context: size of the vector that it keeps of a demonstration: units of the LSTM where there is one.
    """

    context: int = number(512, 1, LARGEST_SIZE)


@dataclasses.dataclass
class RecurrentConfig(ContextConfig):
    """The networks of the LSTM baseline.

    Attributes:
        context_frames: time steps of a demonstration that the LSTM reads.
    """

    context_frames: int = number(10, 1, 10_000)


class ContextNetwork(NamedTuple):
    """The networks as pure functions.

    Attributes:
        init: key -> params.
        encode: (params, image [T, H, W, 3 N] uint8 or None, whitened state [T, S], whitened action [T, A]) -> context,
            a pytree: what is kept of a demonstration. With several cameras `image` is a dictionary of images by name.
        apply: (params, context, image [B, H, W, 3 N] uint8 or None, whitened state [B, S]) -> PolicyOutput.
    """

    init: Callable[[jax.Array], Params]
    encode: Callable[..., Any]
    apply: Callable[..., PolicyOutput]


class LastFrame(nn.Module):
    """The context [D] of a demonstration's last image and state."""

    config: ContextConfig

    @nn.compact
    def __call__(self, image: Any, state: jax.Array, action: jax.Array) -> jax.Array:
        """Encodes as `ContextNetwork.encode` says; ignores the actions."""
        last = state[-1:]
        features = see(self.config, jax.tree.map(lambda x: x[-1:], image), state.dtype)
        last = jnp.concatenate([*(x.reshape(1, -1) for x in listed(features)), last], axis=-1)
        return Dense(self.config.context, hidden=True, norm=self.config.fc_norm)(last)[0]


class Recurrent(nn.Module):
    """The context [D] is an LSTM's output after the last frame (Hochreiter and Schmidhuber 1997).

    It reads `config.context_frames` of them, spread evenly from the first to the last.
    """

    config: RecurrentConfig

    @nn.compact
    def __call__(self, image: Any, state: jax.Array, action: jax.Array) -> jax.Array:
        """Encodes as `ContextNetwork.encode` says."""
        index = np.linspace(0, len(state) - 1, min(len(state), self.config.context_frames)).round().astype(int)
        parts = [state[index], action[index]]
        if image is not None:
            features = listed(see(self.config, jax.tree.map(lambda x: x[index], image), state.dtype))
            flat = jnp.concatenate([x.reshape(len(x), -1) for x in features], axis=-1)
            parts.append(Dense(self.config.fc_layers[0], hidden=True, norm=self.config.fc_norm)(flat))
        cell = nn.OptimizedLSTMCell(self.config.context, param_dtype=state.dtype)
        return nn.RNN(cell, name="lstm")(jnp.concatenate(parts, axis=-1))[-1]


class Actor(nn.Module):
    """The policy that sees the context; its goal head looks for what the context asks for."""

    config: VisionConfig
    action_size: int
    goal_size: int
    goal_camera: str | None = None

    @nn.compact
    def __call__(self, context: jax.Array, image: Any, state: jax.Array) -> PolicyOutput:
        """Acts as `ContextNetwork.apply` says."""
        features, query = see(self.config, image, state.dtype), None
        if self.config.goal_head:
            size = StateGoalHead.candidates if features is None else listed(features)[0].shape[-1]
            query = jnp.broadcast_to(Dense(size)(context), (len(state), size))
        controller = Controller(
            self.config,
            self.action_size,
            self.goal_size,
            self.config.soft_argmax,
            self.config.goal_head,
            goal_camera=self.goal_camera,
            name="controller",
        )
        return controller(features, state, jnp.broadcast_to(context, (len(state), *context.shape)), query)


def make_context_network(encoder: nn.Module, actor: nn.Module, spec: Spec, history: int = 1) -> ContextNetwork:
    """Joins an encoder and an actor.

    Args:
        encoder: maps demonstrations to contexts.
        actor: maps contexts and observations to actions.
        spec: sizes of observations and actions.
        history: N, images of a camera that are side by side in the channels.
    """

    def init(key: jax.Array) -> Params:
        image = black(spec.image_shape, (1,), history)
        state, action = jnp.zeros((1, spec.state_size)), jnp.zeros((1, spec.action_size))
        encoder_key, actor_key = jax.random.split(key)
        context, encoding = encoder.init_with_output(encoder_key, image, state, action)
        return {
            "encoder": encoding["params"],
            "actor": actor.init(actor_key, context, image, state)["params"],
        }

    def encode(params: Params, image: Any, state: jax.Array, action: jax.Array) -> Any:
        return encoder.apply({"params": params["encoder"]}, image, state, action)

    def apply(params: Params, context: Any, image: Any, state: jax.Array) -> PolicyOutput:
        output = actor.apply({"params": params["actor"]}, context, image, state)
        assert isinstance(output, PolicyOutput)
        return output

    return ContextNetwork(init, encode, apply)
