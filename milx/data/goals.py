"""Where the robot was heading at each step of a demonstration, read off its states: what a goal head learns to see."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp

from milx.types import Demo


def goals(state: jax.Array, indices: tuple[int, ...], height: int | None = None, step: int | None = None) -> jax.Array:
    """Computes the goal of every time step, [T, G].

    It is where the robot is at a `step`, or without one, but with a `height`, where the hand first comes down from
    above the middle of its heights to below, and from then on unknown (NaN): where the hand is would be the answer
    then, and a goal head that learns to find hands does not look for what they are about to handle. With neither, it is
    where the demonstration ends.

    Args:
        state: [T, S] of all time steps.
        indices: G entries of the state that tell where the robot is.
        height: the entry that tells how high its hand is.
        step: a time step; the last one where a demonstration is shorter.
    """
    place, time = state[:, jnp.array(indices, int)], jnp.arange(len(state))
    if step is not None:
        reached = jnp.minimum(step, len(state) - 1)
    elif height is not None:
        z = state[:, height]
        low = z < (z.min() + z.max()) / 2
        reached = jnp.argmax(low & (time > jnp.argmin(low)))
    else:
        return jnp.broadcast_to(place[-1], place.shape)
    return jnp.where(time[:, None] < reached, place[reached], jnp.nan)


def with_goals(demo: Demo, indices: tuple[int, ...], **rule: Any) -> Demo:
    """Adds the `goals` to demonstrations [..., T, ...], if entries of their states tell them.

    Args:
        demo: the demonstrations.
        indices: as in `goals`.
        rule: the other arguments of `goals`; `Spec.goal_rule` has those of a policy.
    """
    if demo.state is None or not indices:
        return demo
    compute = jnp.vectorize(functools.partial(goals, indices=indices, **rule), signature="(t,s)->(t,g)")
    return dataclasses.replace(demo, goal=compute(demo.state))
