"""A policy that acts on recorded observations."""

import jax

from milx.methods.base import Method
from milx.types import Demo, Memory, Observation, TaskParams


def replay(method: Method, task_params: TaskParams, demo: Demo) -> jax.Array:
    """Chooses actions [T, A], or chunks, by an adapted policy on the observations of one demonstration [T, ...].

    A policy that remembers sees them one after the other; any other sees them all at once.
    """
    method = method.predictor

    def act(memory: Memory, seen: tuple) -> tuple[Memory, jax.Array]:
        action, memory = method.act(task_params, Observation(*seen), memory)
        return memory, action

    seen, memory = (demo.image, demo.state), method.initial_memory(jax.random.key(0))
    if jax.tree.leaves(memory):
        return jax.lax.scan(act, memory, seen)[1]
    return jax.vmap(lambda one: act(memory, one)[1])(seen)
