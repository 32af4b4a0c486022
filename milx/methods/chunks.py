"""Policies that predict chunks: the actions of the next C time steps, of which some are executed (Zhao et al. 2023)."""

import dataclasses

import jax
import jax.numpy as jnp

from milx.methods.base import Wrapper
from milx.types import Memory, Observation, TaskParams

FADE = 0.01
"""By which the logarithm of a prediction's weight falls with every time step that it is younger (Zhao et al. 2023)."""


@dataclasses.dataclass(frozen=True, eq=False)
class Chunked(Wrapper):
    """A method that predicts chunks [C A] in the place of actions [A], and how they are executed.

    At time step t the policy has the chunks p_t, p_{t-1}, .., p_{t-C+1}, of which p_{t-i} says p_{t-i}[i] of this step.
    With `execute` E >= 1 it does p_{t-i}[i] with i = t mod E: E actions of every E-th chunk. With 0 it does the mean of
    all that there are, with weights exp(FADE i), so that the oldest counts most; entries that take
    two values are those of the newest chunk then.

    Attributes:
        method: predicts chunks; demonstrations and whitening have them, too.
        chunk: C.
        execute: E.
        action_size: A.
        class_indices: entries of the action that take two values.
    """

    chunk: int = dataclasses.field()  # without the default of the class above
    execute: int
    action_size: int
    class_indices: tuple[int, ...] = ()

    @property
    def history(self) -> int:  # type: ignore[override]
        """As the method's."""
        return self.method.history

    def act(self, task_params: TaskParams, observation: Observation, memory: Memory) -> tuple[jax.Array, Memory]:
        """Predicts a chunk and executes; the memory holds the last C chunks, the time step, and the method's memory."""
        inner, plans, step = memory["method"], memory["plans"], memory["step"]
        flat, inner = self.method.act(task_params, observation, inner)
        plan = flat.reshape(self.chunk, -1)
        plans = jnp.concatenate([plan[None], plans[:-1]])
        age = jnp.arange(self.chunk)
        says = plans[age, age]
        weight = jnp.where(age <= step, jnp.exp(FADE * age), 0.0)
        if self.execute:
            weight = (age == step % self.execute).astype(flat.dtype)
        action = weight @ says / weight.sum()
        if not self.execute:
            for i in self.class_indices:
                action = action.at[i].set(plan[0, i])
        return action, {"method": inner, "plans": plans, "step": step + 1}

    def initial_memory(self, key: jax.Array) -> Memory:
        """Returns the memory before the first chunk."""
        plans = jnp.zeros((self.chunk, self.chunk, self.action_size))
        return {"method": self.method.initial_memory(key), "plans": plans, "step": jnp.zeros((), jnp.int32)}
