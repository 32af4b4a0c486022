"""What a data set says of itself: sizes, and the name, split, family and demonstrations of every task."""

import dataclasses
import pathlib
from typing import Any

from milx.core import files
from milx.core.files import FileError
from milx.types import SPLITS

VERSION = 1
"""The number of the layout of data sets."""


@dataclasses.dataclass(frozen=True)
class TaskInfo:
    """A task of a data set.

    Attributes:
        name: what it is called.
        split: "train", "validation" or "test".
        lengths: time steps of each of its demonstrations.
        has_action: whether each of them shows actions.
        family: the kind of task; tasks of one family differ in their goals or objects. "" for none.
    """

    name: str
    split: str
    lengths: tuple[int, ...]
    has_action: tuple[bool, ...]
    family: str = ""


@dataclasses.dataclass(frozen=True)
class Header:
    """What a data set holds.

    Attributes:
        image_shape: (H, W); None without images.
        state_size: S, 0 without states.
        action_size: A.
        tasks: all tasks, in the order of their folders.
        source: where they come from, for people.
    """

    image_shape: tuple[int, int] | None
    state_size: int
    action_size: int
    tasks: tuple[TaskInfo, ...]
    source: str = ""

    def of_split(self, split: str) -> list[int]:
        """Lists the numbers of the split's tasks."""
        return [i for i, task in enumerate(self.tasks) if task.split == split]


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
        if version != VERSION:
            raise ValueError(f"version: got {version!r}, expected {VERSION}")
        return _parse_header(values)
    except (KeyError, TypeError, AttributeError, ValueError, RecursionError) as error:
        raise FileError(f"{path}: expected the header of a milx data set: {error}") from error


def _parse_header(values: dict[str, Any]) -> Header:
    shape = values["image_shape"]
    sizes = [values["state_size"], values["action_size"], *(shape or ())]
    whole = all(isinstance(size, int) and 0 <= size < 1 << 20 for size in sizes) and sizes[1] > 0
    if not whole or (shape is not None and (len(shape) != 2 or 0 in shape)):
        got = f"image_shape {shape}, state_size {sizes[0]} and action_size {sizes[1]}"
        raise ValueError(f"sizes: got {got}, expected whole numbers, two of them for images; actions, too")
    tasks = []
    for i, task in enumerate(values["tasks"]):
        lengths, has_action = tuple(task["lengths"]), tuple(task["has_action"])
        info = TaskInfo(task["name"], task["split"], lengths, has_action, task.get("family", ""))
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
    return Header(
        None if shape is None else tuple(shape),
        values["state_size"],
        values["action_size"],
        tuple(tasks),
        str(values["source"]),
    )
