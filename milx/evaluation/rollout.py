"""A policy that acts in episodes of an environment, in one scan on the device."""

import jax
import jax.numpy as jnp

from milx.envs.base import Env, State, Task
from milx.methods.base import Method
from milx.types import Demo, Observation, TaskParams


def rollout(
    env: Env, method: Method, task_params: TaskParams, task: Task, state: State, key: jax.Array
) -> tuple[State, Demo]:
    """Lets an adapted policy act for one episode.

    Args:
        env: the environment.
        method: whose policy acts.
        task_params: from `method.adapt`.
        task: what the environment judges by and draws.
        state: where the episode starts.
        key: for policies that act at random.

    Returns:
        The states, with a leading axis T + 1, and what the policy saw and did, [T, ...].
    """

    def step(carry: tuple, _: None) -> tuple[tuple, tuple[State, Observation, jax.Array]]:
        state, memory = carry
        observation = env.observe(task, state)
        action, memory = method.act(task_params, observation, memory)
        return (env.step(task, state, action), memory), (state, observation, action)

    start = (state, method.initial_memory(key))
    (last, _), (states, seen, actions) = jax.lax.scan(step, start, length=env.horizon)
    states = jax.tree.map(lambda xs, x: jnp.concatenate([xs, x[None]]), states, last)
    return states, Demo(image=seen.image, state=seen.state, action=actions)
