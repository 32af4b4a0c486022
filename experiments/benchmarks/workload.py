"""Inputs of the right sizes and no meaning."""

from typing import Any

import jax
import jax.numpy as jnp

from milx.data.demos import DemoSet
from milx.envs.base import Env, State
from milx.types import Demo, TaskBatch
from milx.whitening import Whitening


def random_batch(env: Env, tasks: int, frames: int) -> TaskBatch:
    """Images, states and actions without meaning."""

    def demo(key: jax.Array) -> Demo:
        keys = jax.random.split(key, 3)
        image = jax.random.randint(keys[0], (tasks, 1, frames, *env.image_shape, 3), 0, 256).astype(jnp.uint8)
        state = jax.random.normal(keys[1], (tasks, 1, frames, env.state_size))
        return Demo(image, state, jax.random.uniform(keys[2], (tasks, 1, frames, env.action_size), minval=-1))

    return TaskBatch(*(demo(key) for key in jax.random.split(jax.random.key(0))))


def unit_whitening(env: Env) -> Whitening:
    """Whitening that changes nothing."""
    return Whitening(*(fill(n) for n in (env.state_size, env.action_size) for fill in (jnp.zeros, jnp.ones)))


def random_demos(env: Env, num_tasks: int, num_demos: int) -> DemoSet:
    """Demonstrations of the right size: random poses, random actions."""
    keys = jax.random.split(jax.random.key(0), 3)
    tasks = jax.vmap(env.sample_task, in_axes=(0, None))(jax.random.split(keys[0], num_tasks), "train")

    def one(key: jax.Array, task: Any) -> State:
        return jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(key, env.horizon + 1), task)

    states = jax.vmap(jax.vmap(one, in_axes=(0, None)))(jax.random.split(keys[1], (num_tasks, num_demos)), tasks)
    action = jax.random.uniform(keys[2], (num_tasks, num_demos, env.horizon, env.action_size), minval=-1)
    return DemoSet(tasks, states, action, jnp.ones((num_tasks, num_demos), bool))
