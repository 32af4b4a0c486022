"""The data structures that milx's modules exchange, with their shapes.

Letters used in shapes throughout the project:
    `N` tasks, `K` demonstrations of a task (shots), `T` time steps, `H` and `W` image height and width,
    `S` size of the robot's state, `A` size of an action, `G` size of a goal, `O` objects.
"""

import dataclasses
from typing import Any

import jax

Array = Any
"""A `jax.Array`. Public functions also accept NumPy arrays. Inside `jax.eval_shape` it is a `jax.ShapeDtypeStruct`."""

Params = dict[str, Any]
"""A pytree of arrays, a dictionary at its root: the parameters that a method learns."""

TaskParams = Any
"""A pytree of arrays: what a policy has learned of one task, and acts by."""

Memory = Any
"""A pytree of arrays that a policy passes from one time step to the next; `()` for a policy without memory."""


SPLITS = ("train", "validation", "test")
"""Tasks for meta-training, tasks for selecting the best checkpoint, and tasks for the reported result."""

SPEC_FILE = "spec.json"
"""The file with the `Spec` of a run on recorded demonstrations. In other runs the environment provides the `Spec`."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Observation:
    """What a policy observes at one time step. All fields may have the same leading axes in front.

    Attributes:
        image: [H, W, 3] uint8, RGB; None if the policy sees no pixels.
        state: [S] float32, the robot's state in its natural units; without an image it includes the objects' state.
    """

    image: Array = None
    state: Array = None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Demo:
    """One demonstration, or several with leading axes such as `[N, K]`.

    Attributes:
        image: [T, H, W, 3] uint8, RGB; None if the policy sees no pixels.
        state: [T, S] float32; None when the demonstration has no states.
        action: [T, A] float32; None when the demonstration has no actions.
        goal: [T, G] float32, where the robot was heading (`milx.data.goals`), in the units of the state; NaN at time
            steps where it is unknown, None if it is unknown at all of them.
    """

    image: Array = None
    state: Array = None
    action: Array = None
    goal: Array = None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TaskBatch:
    """A meta-batch: demonstrations to adapt to, and demonstrations that the adapted policy must imitate.

    Attributes:
        support: demonstrations to adapt to, with axes [N, K, T, ...].
        query: other demonstrations of the same tasks, to imitate, with axes [N, Q, T, ...].
        task: [N] int32, the tasks' indices in the training set; None if the tasks do not come from one.
    """

    support: Demo
    query: Demo
    task: Array = None


@dataclasses.dataclass(frozen=True)
class Spec:
    """The sizes of a policy's observations and actions, and the meaning of some entries of the state.

    Attributes:
        image_shape: (H, W); None if the policy sees no pixels.
        state_size: S.
        action_size: A.
        action_range: minimum and maximum of each entry of the action; None if actions have no limits.
        goal_indices: indices of the G entries of the state from which goals are read (`milx.data.goals`).
        image_to_goal: three rows of G numbers, the affine map from (x, y, 1), with x and y in [-1, 1] across and down
            the image, to those entries. It comes from the camera's calibration; None if that is unknown.
        object_indices: for each of the O objects the two indices of the entries of the state that hold its position,
            if the state contains them.
        height_index: index of the entry of the state that holds the height of the hand, in environments where the hand
            must come down to an object; None otherwise.
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
        """Returns the fields as a dictionary that can be written as JSON."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "Spec":
        """Builds a `Spec` from the result of `to_dict`, which may have been written to JSON and read back."""
        return cls(**{name: _as_tuple(value) for name, value in values.items()})


def _as_tuple(value: Any) -> Any:
    return tuple(_as_tuple(each) for each in value) if isinstance(value, list) else value
