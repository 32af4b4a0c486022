"""An LSTM that attends to a demonstration and to the objects around it, after Duan et al. 2017 (arXiv:1703.07326).

Every object is embedded at every time step of the demonstration. While the policy acts, an LSTM asks, object by object,
for the time steps that matter, then for the object that matters now, and does so a second time with what it read.
"""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from milx.config.schema import LARGEST_SIZE, NetworkConfig, number
from milx.networks.layers import Dense
from milx.networks.policy_network import Controller, PolicyOutput

_HOPS = 2


@dataclasses.dataclass
class AttentionConfig(NetworkConfig):
    """The networks of the LSTM that attends to objects; they do not look at images.

    Attributes:
        context: units of the LSTM.
    """

    context: int = number(512, 1, LARGEST_SIZE)


def separate_objects(state: jax.Array, object_indices: tuple[tuple[int, ...], ...]) -> tuple[jax.Array, jax.Array]:
    """Splits states [.., S] into the objects' positions [.., O, 2] and all other entries."""
    places = np.array(object_indices)
    rest = np.setdiff1d(np.arange(state.shape[-1]), places)
    return state[..., places], state[..., rest]


class ObjectTokens(nn.Module):
    """Embeds every object at every time step: its place, its number, the time, and what the robot is and does then."""

    config: AttentionConfig
    object_indices: tuple[tuple[int, ...], ...]

    @nn.compact
    def __call__(self, image: jax.Array | None, state: jax.Array, action: jax.Array) -> jax.Array:
        """Maps whitened states [T, S] and actions [T, A] to tokens [T, O, D]; an image is not looked at."""
        places, robot = separate_objects(state, self.object_indices)
        steps, count = places.shape[:2]
        number = jnp.broadcast_to(jnp.eye(count, dtype=state.dtype), (steps, count, count))
        time = jnp.linspace(0, 1, steps, dtype=state.dtype)[:, None]
        seen = jnp.concatenate([robot, action, time], axis=-1)
        seen = jnp.broadcast_to(seen[:, None], (steps, count, seen.shape[-1]))
        x = jnp.concatenate([places, number, seen], axis=-1).reshape(steps * count, -1)
        for size in (self.config.fc_layers[0], self.config.fc_layers[0]):
            x = Dense(size, hidden=True, norm=self.config.fc_norm)(x)
        return x.reshape(steps, count, -1)


class AttentiveActor(nn.Module):
    """Acts on what it reads from the tokens. The weights of both attentions are sown as "intermediates"."""

    config: AttentionConfig
    action_size: int
    object_indices: tuple[tuple[int, ...], ...]

    @nn.compact
    def __call__(self, tokens: jax.Array, image: jax.Array | None, state: jax.Array) -> PolicyOutput:
        """Maps tokens [T, O, D] and whitened states [B, S] to actions; an image is not looked at."""
        places, robot = separate_objects(state, self.object_indices)
        batch, count = places.shape[:2]
        size = tokens.shape[-1]
        cell = nn.OptimizedLSTMCell(self.config.context, param_dtype=state.dtype)
        carry = cell.initialize_carry(jax.random.key(0), robot.shape)
        carry = jax.tree.map(lambda x: x.astype(state.dtype), carry)
        keys, values = Dense(size)(tokens), Dense(size)(tokens)
        ask_time, ask_object, score = Dense(size), Dense(size), Dense(1)
        number = jnp.broadcast_to(jnp.eye(count, dtype=state.dtype), (batch, count, count))

        place, memory = jnp.zeros_like(places[:, 0]), jnp.zeros((batch, size), state.dtype)
        for _ in range(_HOPS):
            carry, h = cell(carry, jnp.concatenate([robot, place, memory], axis=-1))
            heat = jnp.einsum("toc,bc->bto", keys, ask_time(jnp.concatenate([h, robot], axis=-1))) / size**0.5
            when = jax.nn.softmax(heat, axis=1)
            self.sow("intermediates", "time", when)
            read = jnp.einsum("bto,toc->boc", when, values)
            asked = jnp.broadcast_to(h[:, None], (batch, count, h.shape[-1]))
            told = jnp.concatenate([read, places, number, asked], axis=-1)
            which = jax.nn.softmax(score(jnp.tanh(ask_object(told)))[..., 0], axis=1)
            self.sow("intermediates", "object", which)
            place, memory = jnp.einsum("bo,boi->bi", which, places), jnp.einsum("bo,boc->bc", which, read)
        controller = Controller(self.config, self.action_size, 0, name="controller")
        return controller(None, robot, jnp.concatenate([place, memory, h], axis=-1))
