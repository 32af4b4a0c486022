"""Fixtures of the planners by sampling: a world of a few lines."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from milx.envs.base import State
from milx.envs.steering import Steering


class Cart:
    """A cart on a line, driven by a force towards a place, which is the task. Its approximation is a lighter one."""

    name, horizon, ahead, action_size = "cart", 12, 8, 1
    action_range = -jnp.ones(1), jnp.ones(1)

    @property
    def steering(self):
        """In halves of the action; the cart returns to where it is expected."""
        correction = lambda state, expected: 2 * (expected.qpos - state.qpos)  # noqa: E731
        low, high = self.action_range
        return Steering(2 * low, 2 * high, jnp.full(1, 0.5), lambda state, u: u / 2, correction)

    def sample_task(self, key, split):
        return jax.random.uniform(key, (1,), minval=-0.5, maxval=0.5)

    def reset(self, key, task):
        return State(0.1 * jax.random.normal(key, (1,)), jnp.zeros(1), jnp.zeros((0, 3)))

    def _moved(self, state, action, mass):
        velocity = state.qvel + 0.25 * jnp.clip(action, *self.action_range) / mass
        return dataclasses.replace(state, qpos=state.qpos + 0.25 * velocity, qvel=velocity)

    def step(self, task, state, action):
        return self._moved(state, action, 1.0)

    def approximate_step(self, task, state, action):
        return self._moved(state, action, 0.8)

    def running_residual(self, task, state, action, t):
        return jnp.concatenate([state.qpos - task, 0.1 * action])

    def terminal_residual(self, task, state):
        return 3 * jnp.concatenate([state.qpos - task, state.qvel])

    def robot_state(self, state):
        return jnp.concatenate([state.qpos, state.qvel])

    def misjudge(self, key, state):
        return dataclasses.replace(state, qpos=state.qpos + 0.02 * jax.random.normal(key, (1,)))

    def visible(self, task, state):
        return jnp.zeros(0)

    def success(self, task, states):
        return jnp.abs(states.qpos[-1] - task)[0] < 0.1

    def other_criteria(self, task, states):
        return {}


@pytest.fixture(scope="module")
def cart():
    return Cart()


@pytest.fixture(scope="module")
def scenes(cart):
    """Tasks, scenes and keys of 40 episodes."""
    keys = jax.random.split(jax.random.key(1), 40)
    tasks = jax.vmap(cart.sample_task, in_axes=(0, None))(keys, "train")
    return tasks, jax.vmap(cart.reset)(keys, tasks), keys
