"""Which time steps of a demonstration are part of a batch."""

import jax
import jax.numpy as jnp
import numpy as np

from milx.types import Array


def next_frames(frames: np.ndarray, length: int, chunk: int) -> np.ndarray:
    """Lists for each of these time steps [T] itself and those after it, [T, chunk]; the last one is repeated."""
    return np.minimum(frames[:, None] + np.arange(chunk), length - 1)


def previous_frames(frames: np.ndarray, history: int) -> np.ndarray:
    """Lists for each of these time steps [T] itself and those before it, [T, history]; the first one is repeated."""
    return np.maximum(frames[:, None] - np.arange(history), 0)


def in_chunks(action: Array, chunk: int) -> Array:
    """Puts actions [..., T, A] of the next time steps side by side, [..., T, chunk A]; the last one is repeated."""
    length = action.shape[-2]
    return action[..., next_frames(np.arange(length), length, chunk), :].reshape(*action.shape[:-1], -1)


def frame_indices(key: jax.Array, length: int, count: int | None, exponent: float = 1.0) -> jax.Array:
    """Draws n = `count` increasing time steps below T = `length`, one from each of n - 1 parts, and the last one.

    Part i = 0, .., n - 2 begins at floor((T - 1) (i / (n - 1))^e), or one after the part before it if that is later,
    with the exponent e: at 1 the parts are equally long, above 1 the first ones are the shortest. With `count` None or
    at least T, all time steps are returned.
    """
    if count is None or count >= length:
        return jnp.arange(length)
    part = np.arange(count)
    edges = np.floor((length - 1) * part**exponent / max(count - 1, 1) ** exponent).astype(int)
    edges = np.maximum.accumulate(edges - part) + part  # no part is empty
    offset = jax.random.uniform(key, (count - 1,)) * np.diff(edges)
    return jnp.append(edges[:-1] + offset.astype(jnp.int32), length - 1)
