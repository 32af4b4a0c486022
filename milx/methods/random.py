"""A policy that sees nothing: the baseline of all others."""

import dataclasses

import jax
import jax.numpy as jnp

from milx.methods.base import Method
from milx.methods.whitening import Whitening
from milx.types import Demo, Memory, Observation, Params, TaskBatch, TaskParams


@dataclasses.dataclass(frozen=True)
class Random(Method):
    """Actions from a standard normal distribution, as in the paper's random baseline.

    Attributes:
        action_size: A.
    """

    action_size: int

    def init(self, key: jax.Array, whitening: Whitening) -> Params:
        """Returns no parameters: there is nothing to learn."""
        return {}

    def loss(
        self, params: Params, batch: TaskBatch, progress: jax.Array | float = 1.0
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Returns zero: there is nothing to learn."""
        return jnp.zeros(()), {"loss": jnp.zeros(len(batch.query.action))}

    def adapt(self, params: Params, demo: Demo) -> TaskParams:
        """Ignores the demonstration."""
        return {}

    def act(self, task_params: TaskParams, observation: Observation, memory: Memory) -> tuple[jax.Array, Memory]:
        """Draws an action; the memory is a key."""
        key, next_key = jax.random.split(memory)
        return jax.random.normal(key, (self.action_size,)), next_key

    def initial_memory(self, key: jax.Array) -> Memory:
        """Returns the key of the episode's draws."""
        return key
