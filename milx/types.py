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


SPLITS = ("train", "validation", "test")
"""Tasks to learn from, to choose the best checkpoint by, and to report the result on."""

SPEC_FILE = "spec.json"
"""In the folder of a run on recorded demonstrations: its `Spec`, which an environment tells otherwise."""


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
        goal: [T, G] float32, where the robot was heading (`milx.data.goals`), in the units of the state; NaN where
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


@dataclasses.dataclass(frozen=True)
class Spec:
    """The sizes of what a policy sees and does.

    Attributes:
        image_shape: (H, W); None where the policy sees no pixels.
        state_size: S.
        action_size: A.
        action_range: lowest and highest entry of each action; None without limits.
        goal_indices: entries of the state that tell where the robot is heading (`milx.data.goals`).
        image_to_goal: [3][G] affine map from (x, y, 1), x and y in [-1, 1] across and down the image, to those entries,
            from the camera's calibration; None if that is not known.
        object_indices: [O][2] entries of the state with each object's place, where the state tells them.
        height_index: entry of the state that tells how high the hand is, where it must come down to an object.
    """

    image_shape: tuple[int, int] | None
    state_size: int
    action_size: int
    action_range: tuple[tuple[float, ...], tuple[float, ...]] | None
    goal_indices: tuple[int, ...]
    image_to_goal: tuple[tuple[float, ...], ...] | None = None
    object_indices: tuple[tuple[int, ...], ...] = ()
    height_index: int | None = None

    def to_dict(self) -> dict[str, Any]:
        """As JSON can hold it."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "Spec":
        """The inverse of `to_dict`, also after a trip through JSON."""
        return cls(**{name: _as_tuple(value) for name, value in values.items()})


def _as_tuple(value: Any) -> Any:
    return tuple(_as_tuple(each) for each in value) if isinstance(value, list) else value
