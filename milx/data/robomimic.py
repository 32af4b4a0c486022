"""Imports demonstrations in robomimic's layout of HDF5: data/demo_0/obs/agentview_image, data/demo_0/actions, ...

    python -m milx.data.robomimic PATH OUT --camera=agentview_image --state=robot0_eef_pos,robot0_gripper_qpos

PATH is a file, or a folder of *.hdf5 files. Every file is a task (--task=file), or a JSON file says which task a group
belongs to, by names such as "lift/demo_0", the file without its suffix and the group.
"""

import contextlib
import functools
import json
import pathlib
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
from absl import app

from milx.core import files
from milx.core.files import FileError
from milx.data import cameras, command_line
from milx.data.dataset import check_size
from milx.data.episodes import Contents, Episode
from milx.data.header import MOST_FPS
from milx.data.mapping import lookup, read_mapping
from milx.types import Demo, by_field


class Robomimic:
    """One or several files of robomimic's layout, opened for reading.

    Args:
        path: a file, or a folder of *.hdf5 files.
        camera: the observation that holds images, or several separated by commas; "" for none, None for the only one.
        state: observations that together are the robot's state, separated by commas; "" for none.
        action: the data set that holds the actions; "" for none.
        height: maximum number of rows of an image; larger ones are shrunk.

    Raises:
        ValueError: if there are no such files, or the first demonstration lacks something or has it in another shape.
    """

    def __init__(self, path: str | pathlib.Path, camera: str | None, state: str, action: str, height: int):
        root = pathlib.Path(path)
        self.files = [root]
        if root.is_dir():
            self.files = [files.inside(root, file.name) for file in sorted(root.glob("*.hdf5"))]
        if not self.files or not self.files[0].is_file():
            raise ValueError(f"{path}: expected a file in robomimic's layout, or a folder of *.hdf5 files")
        self.state, self.action = [name for name in state.split(",") if name], action
        with _open(self.files[0]) as file:
            demo = _demos(file)[0]
            self.cameras = cameras.named(self._only_camera(file, demo) if camera is None else camera)
            lead = f"data/{demo}/obs"
            shape = lambda key: cameras.shrunk(_dataset(file, f"{lead}/{key}", 4).shape[1:], height)  # noqa: E731
            image_shape = cameras.joined({name: shape(key) for name, key in self.cameras.items()})
            sizes = {name: _dataset(file, f"{lead}/{name}", 2).shape[1] for name in self.state}
            actions = _dataset(file, f"data/{demo}/{action}", 2).shape[1] if action else 0
        rates = set[float | None]()
        for path in self.files:
            with _open(path) as file:
                rates.add(_fps(file))
        fps = rates.pop() if len(rates) == 1 else None
        names = tuple(f"{name}.{i}" for name, size in sizes.items() for i in range(size))
        self.contents = Contents(image_shape, len(names), actions, fps, state_names=names)

    def episodes(self, task: str) -> list[Episode]:
        """Lists all demonstrations.

        Args:
            task: "file", or the path of a JSON file.
        """
        mapping = None if task == "file" else read_mapping(task, "task")
        found = []
        for path in self.files:
            with _open(path) as file:
                for demo in _demos(file):
                    name = f"{path.stem}/{demo}"
                    own = path.stem if mapping is None else lookup(mapping, name, task, "task")
                    length, read = 0, functools.partial(self._read, path, demo)
                    with contextlib.suppress(FileError):  # reading it says what is wrong
                        length = self._length(file, demo)
                    found.append(Episode(name, own, length, bool(self.action), read))
        return found

    def _names(self, demo: str) -> dict[str, int]:
        """Names the data sets that are read of a demonstration, and their axes."""
        names = {f"data/{demo}/obs/{name}": 2 for name in self.state}
        names |= {f"data/{demo}/obs/{key}": 4 for key in self.cameras.values()}
        if self.action:
            names[f"data/{demo}/{self.action}"] = 2
        return names

    def _length(self, file: Any, demo: str) -> int:
        lengths = {name: len(_dataset(file, name, axes)) for name, axes in self._names(demo).items()}
        if len(set(lengths.values())) != 1 or 0 in lengths.values():
            raise FileError(f"{file.filename}: data/{demo}: got lengths {lengths}, expected one that is at least 1")
        return next(iter(lengths.values()))

    def _read(self, path: pathlib.Path, demo: str) -> Demo:
        with _open(path) as file:
            self._length(file, demo)
            lead = f"data/{demo}"
            action = _dataset(file, f"{lead}/{self.action}", 2)[:] if self.action else None
            states = [_dataset(file, f"{lead}/obs/{name}", 2)[:] for name in self.state]
            shapes, images = by_field(self.contents.image_shape).values(), {}
            for (name, key), shape in zip(self.cameras.items(), shapes, strict=True):
                frames = _dataset(file, f"{lead}/obs/{key}", 4)
                if frames.dtype != np.uint8 or frames.shape[-1] != 3:
                    got = f"{frames.dtype} {list(frames.shape)}"
                    raise FileError(f"{path}: {frames.name}: got {got}, expected uint8 [T, H, W, 3]")
                images[name] = np.stack(list(cameras.resized(frames, shape)))
            return Demo(cameras.joined(images), np.concatenate(states, axis=1) if states else None, action)

    def _only_camera(self, file: Any, demo: str) -> str:
        found = [name for name in _members(file, f"data/{demo}/obs") if name.endswith("_image")]
        if len(found) > 1:
            raise FileError(f"camera: expected one or several of {','.join(found)}, or none with --camera=")
        return found[0] if found else ""


@contextlib.contextmanager
def _open(path: pathlib.Path) -> Iterator[Any]:
    """Opens a file; whatever fails while it is open is a FileError that names it."""
    try:
        import h5py
    except ImportError as error:
        raise ValueError("reading robomimic's files needs h5py: install milx with the extra 'robomimic'") from error
    try:
        with h5py.File(path, "r") as file:
            yield file
    except FileError:
        raise
    except Exception as error:  # on damaged bytes h5py raises nearly all types of errors
        raise FileError(f"{path}: expected an HDF5 file that can be read: {error!r:.300}") from error


def _fps(file: Any) -> float | None:
    """Returns the time steps in a second, robosuite's control frequency; None where the file does not say."""
    try:
        found = json.loads(file["data"].attrs["env_args"])["env_kwargs"]["control_freq"]
    except (KeyError, TypeError, ValueError, RecursionError):
        return None
    is_number = isinstance(found, int | float) and not isinstance(found, bool)
    return float(found) if is_number and 0 < found < MOST_FPS else None


def _demos(file: Any) -> list[str]:
    """Lists the names of the demonstrations, demo_2 before demo_10."""
    names = _members(file, "data")
    if not names:
        raise FileError(f"{file.filename}: expected demonstrations under data/, there are none")
    number = lambda name: int((re.findall(r"\d+", name) or ["0"])[-1])  # noqa: E731
    return sorted(names, key=lambda name: (number(name), name))


def _dataset(file: Any, name: str, axes: int) -> Any:
    """Opens an HDF5 data set, unless it is missing, of another shape, too large, or stored outside the file."""
    import h5py

    _check_links(file, name)
    where, found = f"{file.filename}: {name}", file.get(name)
    if not isinstance(found, h5py.Dataset):
        there = ", ".join(_members(file, name.rpartition("/")[0])) or "nothing"
        raise FileError(f"{where}: missing, expected it beside {there}")
    if found.is_virtual or found.external:
        raise FileError(f"{where}: is stored outside the file, expected inside: nothing else is read")
    if found.ndim != axes or found.dtype.kind not in "fiu":
        raise FileError(f"{where}: got {found.dtype} {list(found.shape)}, expected numbers with {axes} axes")
    if 0 in found.shape[1:]:
        raise FileError(f"{where}: got shape {list(found.shape)}, expected something in every row")
    check_size(where, found.shape, found.dtype.itemsize)
    return found


def _members(file: Any, name: str) -> list[str]:
    """Lists the names in a group; none if it is no group."""
    import h5py

    _check_links(file, name)
    group = file.get(name)
    return list(group) if isinstance(group, h5py.Group) else []


def _check_links(file: Any, name: str) -> None:
    """Raises ValueError if the way to `name` leads out of the file; no link of another file is opened."""
    import h5py

    at = file
    for part in name.split("/"):
        link = at.get(part, getlink=True) if isinstance(at, h5py.Group) else None
        if isinstance(link, h5py.ExternalLink | h5py.SoftLink):
            raise FileError(
                f"{file.filename}: {name}: {part} is a link out of its group, expected data inside: it is not followed"
            )
        at = None if link is None else at.get(part)


def main(argv: list[str]) -> None:
    """Imports PATH as OUT."""
    command_line.run(argv, lambda path, flags: Robomimic(path, flags.camera, flags.state, flags.action, flags.height))


if __name__ == "__main__":
    command_line.define_flags(state="robot0_eef_pos,robot0_eef_quat,robot0_gripper_qpos", action="actions", task="file")
    app.run(main)
