"""The records that flow through milx, their shapes said once.

Letters used in shapes throughout the project:
    `N` tasks, `K` demonstrations of a task (shots), `T` time steps, `H`, `W` image height and width,
    `S` size of the robot's state, `A` size of an action, `G` size of a goal, `O` objects.
"""

import dataclasses
from typing import Any

import jax

Array = Any
"""A `jax.Array`; at milx's doors also a NumPy array, and inside `jax.eval_shape` a `jax.ShapeDtypeStruct`."""

Params = Any
"""A pytree of arrays: what a method learns, or what it has adapted to one task."""

Memory = Any
"""A pytree of arrays that a policy carries from one time step to the next; `()` if it carries none."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Observation:
    """What a policy sees at one time step (any leading axes may stand in front).

    Attributes:
        image: [H, W, 3] uint8, RGB; None where the policy sees no pixels.
        state: [S] float32, the robot's own state in its natural units, and the objects' where there is no image.
    """

    image: Array = None
    state: Array = None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Demo:
    """One demonstration, or several with leading axes such as `[N, K]`.

    Attributes:
        image: [T, H, W, 3] uint8, RGB; None where policies see no pixels.
        state: [T, S] float32; None when the demonstration has no states.
        action: [T, A] float32; None when the demonstration has no actions.
        goal: [T, G] float32, where the robot was heading (`milx.goals`), in the units of the state; NaN where
            unknown, None if it is everywhere.
    """

    image: Array = None
    state: Array = None
    action: Array = None
    goal: Array = None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TaskBatch:
    """A meta-batch: what every task is learnt from, and what the adapted policy must then imitate.

    Attributes:
        support: demonstrations with axes [N, K, T, ...].
        query: other demonstrations of the same tasks, with axes [N, Q, T, ...].
        task: [N] int32, their numbers in the training set; None if they are from nowhere.
    """

    support: Demo
    query: Demo
    task: Array = None
