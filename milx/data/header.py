"""What a data set says of itself: sizes, and the name, split, family and demonstrations of every task."""

import dataclasses
import numbers
import pathlib
import re
from typing import Any

from milx.core import files
from milx.core.files import FileError
from milx.types import SPLITS, ImageShape, are_indices, by_field, is_image_shape

VERSION = 2
"""The number of the layout of data sets. Those of version 1 have one camera."""
MOST_FPS = 1e6
"""What says that there are more time steps in a second is no rate."""


@dataclasses.dataclass(frozen=True)
class TaskInfo:
    """A task of a data set.

    Attributes:
        name: what it is called.
        split: "train", "validation" or "test".
        lengths: time steps of each of its demonstrations.
        has_action: whether each of them shows actions.
        family: the kind of task; tasks of one family differ in their goals or objects. "" for none.
        instructions: what was said to be done in each of its demonstrations; empty if nothing was.
    """

    name: str
    split: str
    lengths: tuple[int, ...]
    has_action: tuple[bool, ...]
    family: str = ""
    instructions: tuple[str, ...] = ()

    def suffices(self, shots: int, given_action: bool) -> bool:
        """Tells whether a policy can adapt to so many demonstrations and be judged by the actions of another one.

        Args:
            shots: demonstrations to adapt to.
            given_action: whether these have to show actions, too.
        """
        support = sum(self.has_action) if given_action else len(self.lengths)
        return any(self.has_action) and support > shots


@dataclasses.dataclass(frozen=True)
class Header:
    """What a data set holds.

    Attributes:
        image_shape: (H, W); with several cameras a dictionary of them by name; None without images.
        state_size: S, 0 without states.
        action_size: A.
        tasks: all tasks, in the order of their folders.
        source: where they come from, for people.
        fps: time steps in a second; None if it is not known.
        state_names: of the entries of the state; empty if they have none.
        action_names: of the entries of the action, likewise.
        class_indices: indices of the entries of the action that take two values, such as an open and a closed gripper.
    """

    image_shape: ImageShape
    state_size: int
    action_size: int
    tasks: tuple[TaskInfo, ...]
    source: str = ""
    fps: float | None = None
    state_names: tuple[str, ...] = ()
    action_names: tuple[str, ...] = ()
    class_indices: tuple[int, ...] = ()

    def of_split(self, split: str) -> list[int]:
        """Lists the numbers of the split's tasks."""
        return [i for i, task in enumerate(self.tasks) if task.split == split]

    def entry(self, field: str, index: int) -> str:
        """Names an entry of the "state" or of the "action"."""
        return named_entry(field, index, getattr(self, f"{field}_names"))


def named_entry(field: str, index: int, names: tuple[str, ...]) -> str:
    """Names an entry of a field by its index, and by its name if the entries have names."""
    return f"{field}[{index}]" + (f" ({names[index]})" if names else "")


def read_header(folder: pathlib.Path) -> Header:
    """Reads the header of a data set.

    Raises:
        ValueError: if the folder holds no data set.
        FileError: if its header is not one of this version.
    """
    path = folder / "zarr.json"
    if not path.is_file():
        raise ValueError(f"data: {folder} has no zarr.json, expected a folder written by milx.data")
    whole = files.read_json(path)
    try:
        values = dict(whole["attributes"]["milx"])
        version = values.pop("version")
        if version not in range(1, VERSION + 1):
            raise ValueError(f"version: got {version!r}, expected 1 to {VERSION}")
        return parse_header(values)
    except (KeyError, TypeError, AttributeError, ValueError, RecursionError) as error:
        raise FileError(f"{path}: expected the header of a milx data set: {error}") from error


def parse_header(values: dict[str, Any]) -> Header:
    """Builds a header from a dictionary with its fields.

    Raises:
        KeyError: for a field that is missing.
        ValueError: for a value that is not possible; others may be a TypeError or an AttributeError.
    """
    shape = check_cameras(values["image_shape"])
    sizes = values["state_size"], values["action_size"]
    if not all(isinstance(size, int) and 0 <= size < 1 << 20 for size in sizes) or not sizes[1]:
        got = f"state_size {sizes[0]!r:.20} and action_size {sizes[1]!r:.20}"
        raise ValueError(f"sizes: got {got}, expected whole numbers; at least one action")
    tasks = []
    for i, task in enumerate(values["tasks"]):
        lengths, has_action = tuple(task["lengths"]), tuple(task["has_action"])
        said = texts(f"tasks[{i}].instructions", task.get("instructions", ()), len(lengths))
        info = TaskInfo(task["name"], task["split"], lengths, has_action, task.get("family", ""), said)
        for field in ("name", "family"):
            if not isinstance(getattr(info, field), str):
                raise ValueError(f"tasks[{i}].{field}: got {getattr(info, field)!r:.100}, expected text")
        if info.split not in SPLITS:
            raise ValueError(f"tasks[{i}].split: got {info.split!r}, expected one of {', '.join(SPLITS)}")
        if not all(isinstance(length, int) and 0 < length < 1 << 40 for length in info.lengths):
            raise ValueError(f"tasks[{i}].lengths: got {list(info.lengths)}, expected positive numbers")
        if len(info.has_action) != len(info.lengths):
            raise ValueError(f"tasks[{i}].has_action: got {len(info.has_action)}, expected {len(info.lengths)}")
        tasks.append(info)
    fps = values.get("fps")
    if fps is not None:
        if not isinstance(fps, numbers.Real) or isinstance(fps, bool) or not 0 < float(fps) < MOST_FPS:
            raise ValueError(f"fps: got {fps!r:.100}, expected a positive number")
        fps = float(fps)
    state_names, action_names = (
        texts(f"{field}_names", values.get(f"{field}_names", ()), values[f"{field}_size"]) for field in _VECTORS
    )
    classes = tuple(values.get("class_indices", ()))
    if not are_indices(classes, sizes[1]):
        raise ValueError(f"class_indices: got {classes!r:.100}, expected different indices below {sizes[1]}")
    return Header(shape, *sizes, tuple(tasks), str(values["source"]), fps, state_names, action_names, classes)


_VECTORS = "state", "action"


def _as_size(value: Any) -> Any:
    return tuple(value) if isinstance(value, list | tuple) else value


def texts(field: str, value: Any, count: int) -> tuple[str, ...]:
    """Checks texts, one for each of `count` things or none at all.

    Raises:
        ValueError: for anything else.
    """
    if not isinstance(value, list | tuple) or len(value) not in (0, count):
        raise ValueError(f"{field}: got {value!r:.100}, expected {count} texts, or none")
    if not all(isinstance(text, str) for text in value):
        raise ValueError(f"{field}: got {value!r:.100}, expected texts")
    return tuple(value)


def check_cameras(shape: Any) -> ImageShape:
    """Checks the sizes of images, and returns them as tuples.

    Raises:
        ValueError: for sizes that are not two whole numbers, or a camera whose name cannot be that of a file.
    """
    if isinstance(shape, dict):
        if len(shape) == 1:
            raise ValueError(f"cameras: got {shape!r:.100}, expected (H, W): a single camera has no name")
        if bad := [name for name in shape if not re.fullmatch(r"[A-Za-z0-9_-]{1,64}", name)] or not shape:
            raise ValueError(f"cameras: got the names {bad!r:.200}, expected letters, digits, '_' and '-'")
        shape = {name: _as_size(size) for name, size in shape.items()}
    elif shape is not None:
        shape = _as_size(shape)
    for field, size in by_field(shape).items():
        if not is_image_shape(size):
            raise ValueError(f"{field}: got the shape {size!r:.100}, expected two whole numbers")
    return shape
