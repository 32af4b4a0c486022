"""The data structures that milx's modules exchange, with their shapes.

Letters used in shapes throughout the project:
    `N` tasks, `K` demonstrations of a task (shots), `T` time steps, `H` and `W` image height and width,
    `S` size of the robot's state, `A` size of an action, `G` size of a goal, `O` objects.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

Array = Any
"""A `jax.Array`. Public functions also accept NumPy arrays. Inside `jax.eval_shape` it is a `jax.ShapeDtypeStruct`."""

Params = dict[str, Any]
"""A pytree of arrays, a dictionary at its root: the parameters that a method learns."""

TaskParams = Any
"""A pytree of arrays: what a policy has learned of one task, and acts by."""

Memory = Any
"""A pytree of arrays that a policy passes from one time step to the next; `()` for a policy without memory."""


ImageShape = tuple[int, int] | dict[str, tuple[int, int]] | None
"""(H, W) of images; with several cameras a dictionary of them by name, None where a policy sees no pixels."""

SPLITS = ("train", "validation", "test")
"""Tasks for meta-training, tasks for selecting the best checkpoint, and tasks for the reported result."""

SPEC_FILE = "spec.json"
"""The file with the `Spec` of a run on recorded demonstrations. In other runs the environment provides the `Spec`."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Observation:
    """What a policy observes at one time step. All fields may have the same leading axes in front.

    Attributes:
        image: [H, W, 3] uint8, RGB; with several cameras a dictionary of images by name; None if the policy sees no
            pixels.
        state: [S] float32, the robot's state in its natural units; without an image it includes the objects' state.
    """

    image: Array = None
    state: Array = None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Demo:
    """One demonstration, or several with leading axes such as `[N, K]`.

    Attributes:
        image: [T, H, W, 3] uint8, RGB; with several cameras a dictionary of such arrays by name; None if the policy
            sees no pixels.
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
        image_shape: (H, W); with several cameras a dictionary of them by name, of which the first is what a goal head
            looks at; None if the policy sees no pixels.
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
        fps: time steps in a second of recorded demonstrations; None if it is not known.
        state_names: of the entries of the state; empty if they have none.
        action_names: of the entries of the action, likewise.
        class_indices: indices of the entries of the action that take two values, such as an open and a closed gripper.
        goal_step: the time step of a demonstration at which the robot is at its goal; None where its height tells, or
            where the goal is the end.
    """

    image_shape: ImageShape
    state_size: int
    action_size: int
    action_range: tuple[tuple[float, ...], tuple[float, ...]] | None
    goal_indices: tuple[int, ...]
    image_to_goal: tuple[tuple[float, ...], ...] | None = None
    object_indices: tuple[tuple[int, ...], ...] = ()
    height_index: int | None = None
    fps: float | None = None
    state_names: tuple[str, ...] = ()
    action_names: tuple[str, ...] = ()
    class_indices: tuple[int, ...] = ()
    goal_step: int | None = None

    @property
    def goal_rule(self) -> dict[str, Any]:
        """When the robot is at its goal: the arguments of `milx.data.goals.goals` but for the state and the indices."""
        return {"height": self.height_index, "step": self.goal_step}

    def to_dict(self) -> dict[str, Any]:
        """Returns the fields as a dictionary that can be written as JSON, with the version of their layout."""
        return {"spec_version": 1, **dataclasses.asdict(self)}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> "Spec":
        """Builds a `Spec` from the result of `to_dict`, which may have been written to JSON and read back.

        A field that does not exist is ignored if it is None, as a field is that an earlier version had and the policy
        does not use.

        Raises:
            ValueError: for a field that is missing, does not exist, or has a value that is not possible.
        """
        if not isinstance(values, dict):
            raise ValueError(f"spec: got {values!r:.100}, expected a group of fields")
        version = values.get("spec_version", 1)  # the first specs had no version
        if version != 1:
            raise ValueError(f"spec_version: got {version!r:.100}, expected 1: made by a later milx")
        fields = {name: _as_tuple(value) for name, value in values.items() if name != "spec_version"}
        known = {field.name: field.default is dataclasses.MISSING for field in dataclasses.fields(cls)}
        for name in fields.keys() - known.keys():
            if fields.pop(name) is not None:
                raise ValueError(f"{name!r:.100}: no such field, expected some of {', '.join(known)}")
        for name in known:
            if known[name] and name not in fields:
                raise ValueError(f"{name}: missing, expected a value")
        spec = cls(**fields)
        size, actions = (value if type(value) is int else 0 for value in (spec.state_size, spec.action_size))
        goal, objects = (len(x) if isinstance(x, tuple) else 0 for x in (spec.goal_indices, spec.object_indices))
        good = {
            "image_shape": spec.image_shape != {} and all(map(is_image_shape, by_field(spec.image_shape).values())),
            "state_size": _is_table((spec.state_size,), (1,), 0, _LARGEST),
            "action_size": _is_table((spec.action_size,), (1,), 1, _LARGEST),
            "action_range": spec.action_range is None or _is_table(spec.action_range, (2, actions)),
            "goal_indices": _is_table(spec.goal_indices, (goal,), 0, size),
            "image_to_goal": spec.image_to_goal is None or _is_table(spec.image_to_goal, (3, goal)),
            "object_indices": _is_table(spec.object_indices, (objects, 2), 0, size),
            "class_indices": are_indices(spec.class_indices, actions),
            "fps": spec.fps is None or _is_table((spec.fps,), (1,)),
            "state_names": _are_texts(spec.state_names, size),
            "action_names": _are_texts(spec.action_names, actions),
            "height_index": spec.height_index is None or _is_table((spec.height_index,), (1,), 0, size),
            "goal_step": spec.goal_step is None or _is_table((spec.goal_step,), (1,), 1, _LARGEST),
        }
        for name in (name for name, value in good.items() if not value):
            raise ValueError(f"{name}: got {getattr(spec, name)!r:.100}, expected what a policy of these sizes has")
        return spec


_LARGEST = 1 << 20
"""More than any size of a policy."""


def by_field(image: Any) -> dict[str, Any]:
    """Names the images, or the shapes, of all cameras: "image" if there is one, "image.wrist" if it has the name wrist.

    These are the names of arrays in files, in messages between processes, and in errors. None has no name.
    """
    if image is None:
        return {}
    return {f"image.{camera}": each for camera, each in image.items()} if isinstance(image, dict) else {"image": image}


def from_fields(fields: Mapping[str, Any]) -> Any:
    """Inverts `by_field`; other fields may be among them."""
    if "image" in fields:
        return fields["image"]
    named = {name.removeprefix("image."): value for name, value in fields.items() if name.startswith("image.")}
    return named or None


def is_image(field: str) -> bool:
    """Tells whether an array of this name holds images."""
    return field.partition(".")[0] == "image"


def black(shape: ImageShape, lead: tuple[int, ...] = (), history: int = 1) -> Any:
    """Makes black images [*lead, H, W, 3 N] of these sizes, N = `history` side by side; None without any."""
    channels = 3 * history
    return from_fields({name: np.zeros((*lead, *size, channels), np.uint8) for name, size in by_field(shape).items()})


def is_image_shape(value: Any) -> bool:
    """Tells whether a value is (H, W) of one camera."""
    return _is_table(value, (2,), 1, _LARGEST)


def _as_tuple(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _as_tuple(each) for name, each in value.items()}
    return tuple(_as_tuple(each) for each in value) if isinstance(value, list) else value


def are_indices(value: Any, size: int) -> bool:
    """Tells whether a value is a tuple of different indices below `size`."""
    return isinstance(value, tuple) and len(set(value)) == len(value) and _is_table(value, (len(value),), 0, size)


def _are_texts(value: Any, count: int) -> bool:
    """Tells whether a value is a tuple of so many texts, or of none."""
    return isinstance(value, tuple) and len(value) in (0, count) and all(isinstance(text, str) for text in value)


def _is_table(value: Any, shape: tuple[int, ...], low: int | None = None, high: int = 0) -> bool:
    """Tells whether a value is a nested tuple of this shape: numbers, or integers from `low` below `high`."""
    if shape:
        return (
            isinstance(value, tuple)
            and len(value) == shape[0]
            and all(_is_table(each, shape[1:], low, high) for each in value)
        )
    if low is None:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e30
    return type(value) is int and low <= value < high
