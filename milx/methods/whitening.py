"""Whitening of states and actions with statistics of the training tasks only."""

import dataclasses
import math

import jax
import jax.numpy as jnp

from milx.types import Array

MIN_STD = 1e-3
"""Entries that hardly vary are divided by this and no less (as the paper's released code does)."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Whitening:
    """Means and scales of what a policy sees and does.

    Attributes:
        state_mean: [S].
        state_scale: [S], at least MIN_STD.
        action_mean: [A].
        action_scale: [A], at least MIN_STD.
    """

    state_mean: Array
    state_scale: Array
    action_mean: Array
    action_scale: Array

    def state(self, state: jax.Array) -> jax.Array:
        """Whitens states [..., S]."""
        return (state - self.state_mean) / self.state_scale

    def action(self, action: jax.Array) -> jax.Array:
        """Whitens actions [..., A]."""
        return (action - self.action_mean) / self.action_scale

    def unwhiten_action(self, action: jax.Array, class_indices: tuple[int, ...] = ()) -> jax.Array:
        """Inverts `action`; entries that are classes become the nearer of their two values."""
        for i in class_indices:
            action = action.at[..., i].set(jnp.where(action[..., i] < 0, -1.0, 1.0))
        return action * self.action_scale + self.action_mean


def fit(state: jax.Array, action: jax.Array, whiten_actions: bool, class_indices: tuple[int, ...] = ()) -> Whitening:
    """Computes statistics over all leading axes of states [..., S] and actions [..., A] of the training tasks.

    With `whiten_actions` false, actions pass unchanged. Entries of actions that are classes become -1 and 1 in any
    case, for the smaller and the larger of their two values.
    """

    def moments(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        x = x.reshape(math.prod(x.shape[:-1]), x.shape[-1])  # which may be 0
        return x.mean(axis=0), jnp.maximum(x.std(axis=0), MIN_STD)

    action_mean, action_scale = moments(action)
    if not whiten_actions:
        action_mean, action_scale = jnp.zeros_like(action_mean), jnp.ones_like(action_scale)
    for i in class_indices:
        low, high = action[..., i].min(), action[..., i].max()
        action_mean = action_mean.at[i].set((low + high) / 2)
        action_scale = action_scale.at[i].set(jnp.maximum((high - low) / 2, MIN_STD))
    return Whitening(*moments(state), action_mean, action_scale)
