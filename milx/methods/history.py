"""Policies that see a short history: the latest N observations side by side, in the place of the latest alone."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from milx.methods.base import Wrapper
from milx.types import ImageShape, Memory, Observation, TaskParams, black


def stacked(image: Any, state: Any) -> tuple[Any, Any]:
    """Puts N observations side by side, the latest first, so that indices of entries of its state stay what they are.

    Args:
        image: [..., N, H, W, C]; of several cameras a dictionary by name, None for none.
        state: [..., N, S]; None for none.

    Returns:
        Images [..., H, W, N C] and states [..., N S].
    """

    def join(x: Any) -> Any:
        return x.reshape(*x.shape[:-2], x.shape[-2] * x.shape[-1])

    return jax.tree.map(lambda x: join(x.swapaxes(-4, -3).swapaxes(-3, -2)), image), jax.tree.map(join, state)


@dataclasses.dataclass(frozen=True, eq=False)
class History(Wrapper):
    """A method that sees the latest N observations `stacked`; the first of an episode stands for those before it.

    Attributes:
        method: demonstrations and whitening have the observations side by side, too.
        history: N.
        image_shape: of an observation (`Spec.image_shape`).
        state_size: S.
    """

    history: int = dataclasses.field()  # without the default of the class above
    image_shape: ImageShape
    state_size: int

    def act(self, task_params: TaskParams, observation: Observation, memory: Memory) -> tuple[jax.Array, Memory]:
        """Acts on the history; the memory holds the N - 1 observations before, if there are any, and the method's."""
        before = jax.tree.map(lambda x, now: jnp.where(memory["begun"], x, now), memory["before"], observation)
        seen = jax.tree.map(lambda now, x: jnp.concatenate([now[None], x]), observation, before)
        both = Observation(*stacked(seen.image, seen.state))
        action, inner = self.method.act(task_params, both, memory["method"])
        before = jax.tree.map(lambda x: x[:-1], seen)
        return action, {"method": inner, "before": before, "begun": jnp.ones((), bool)}

    def initial_memory(self, key: jax.Array) -> Memory:
        """Returns the memory before the first observation."""
        before = self.history - 1
        image = jax.tree.map(jnp.asarray, black(self.image_shape, (before,)))
        nothing = Observation(image, jnp.zeros((before, self.state_size)))
        return {"method": self.method.initial_memory(key), "before": nothing, "begun": jnp.zeros((), bool)}
