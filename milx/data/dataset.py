"""Recorded demonstrations on disk: one folder for a data set, chunked arrays by task, readable with zarr alone.

    zarr.json               a zarr (version 3) group; its attributes hold the header
    00000/                  the first task: a group with all its demonstrations, one after the other
        image               [F, H, W, 3] uint8, where there are images; image.NAME for each of several cameras
        state               [F, S] float32
        action              [F, A] float32, NaN where a demonstration shows none

Every chunk carries a checksum, so one that has changed or is missing is noticed when it is read.

The header names every task, its split ("train", "validation" or "test") and the lengths of its demonstrations.
"""

import contextlib
import dataclasses
import hashlib
import json
import math
import pathlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import tensorstore as ts

from milx.core import files
from milx.core.files import MAX_BYTES, FileError
from milx.data.header import VERSION, Header, TaskInfo, parse_header, read_header, texts
from milx.types import SPLITS, Demo, ImageShape, by_field, from_fields, is_image

ALL_FIELDS = ("image", "state", "action")
LARGEST = 1e12
"""The largest state or action whose squares can be summed in float32."""
_CHUNK_BYTES = 1 << 20
_MAX_CHUNK_BYTES = 1 << 28
_GROUP = {"zarr_format": 3, "node_type": "group"}


class Writer:
    """Writes a data set task by task; the folder appears when all of it is written.

        with Writer(folder, image_shape=(128, 128), state_size=8, action_size=7) as writer:
            writer.add("pick up the cup", "train", [len(demo.state) for demo in demos], demos)

    Args:
        folder: the data set's; must not exist.
        image_shape: (H, W); with several cameras a dictionary of them by name; None without images.
        state_size: S.
        action_size: A.
        source: where the demonstrations come from.
        fps: time steps in a second; None if it is not known.
        state_names: of the entries of the state; none if they have none.
        action_names: of the entries of the action, likewise.
        class_indices: indices of the entries of the action that take two values, such as an open and a closed gripper.

    Raises:
        ValueError: if the folder exists, as nothing is written over, there are no actions, or for sizes and names that
            do not fit.
    """

    def __init__(
        self,
        folder: str | pathlib.Path,
        image_shape: ImageShape,
        state_size: int,
        action_size: int,
        source: str = "",
        fps: float | None = None,
        state_names: Sequence[str] = (),
        action_names: Sequence[str] = (),
        class_indices: Sequence[int] = (),
    ):
        self.folder = pathlib.Path(folder)
        if self.folder.exists():
            raise ValueError(f"out: {self.folder} exists, expected a folder that does not: nothing is written over")
        if action_size < 1:
            raise ValueError(f"action_size: got {action_size}, expected at least 1: there is nothing to imitate")
        self._header = parse_header(
            {"image_shape": image_shape, "state_size": state_size, "action_size": action_size, "tasks": ()}
            | {"source": source, "fps": fps, "state_names": state_names, "action_names": action_names}
            | {"class_indices": class_indices}
        )
        self._tasks: list[TaskInfo] = []
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> "Writer":
        """Starts from nothing; what an earlier attempt left unfinished is removed."""
        self._partial = self._stack.enter_context(files.creating(self.folder))
        self._stack.push(self._write_header)
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: Any) -> None:
        """Puts the folder in its place, or removes what was written if something went wrong."""
        self._stack.__exit__(kind, *error)

    def _write_header(self, kind: type[BaseException] | None, *_: Any) -> None:
        if kind is None:
            header = dataclasses.replace(self._header, tasks=tuple(self._tasks))
            _write_group(self._partial, {"milx": {"version": VERSION, **dataclasses.asdict(header)}})

    def add(
        self,
        name: str,
        split: str,
        lengths: list[int],
        demos: Iterable[Demo],
        family: str = "",
        instructions: Sequence[str] = (),
    ) -> None:
        """Writes a task.

        Args:
            name: of the task.
            split: "train", "validation" or "test".
            lengths: time steps of its demonstrations.
            demos: as many; with arrays [T, ...], and no action where the demonstration shows none.
            family: the kind of task; "" for none.
            instructions: what was said to be done in each demonstration; none if nothing was.

        Raises:
            ValueError: for a split that does not exist, or a demonstration without time steps or of another shape than
                announced, or if it cannot be written.
        """
        if 0 in lengths:
            raise ValueError(f"demonstration {lengths.index(0)} of {name!r}: got no time steps, expected at least one")
        texts(f"instructions of {name!r}", instructions, len(lengths))
        if split not in SPLITS:
            raise ValueError(f"split of {name!r}: got {split!r}, expected one of {', '.join(SPLITS)}")
        folder, total, head = self._partial / f"{len(self._tasks):05d}", sum(lengths), self._header
        _write_group(folder, {"name": name})
        arrays = {
            field: _create(folder / field, (total, *shape), dtype) for field, (shape, dtype) in _fields(head).items()
        }
        start, has_action, said = 0, [], tuple(instructions) if any(instructions) else ()
        for i, (length, demo) in enumerate(zip(lengths, demos, strict=True)):
            has_action.append(demo.action is not None)
            if demo.action is None:
                demo = dataclasses.replace(demo, action=np.full((length, head.action_size), np.nan))
            values = {**by_field(demo.image), "state": demo.state, "action": demo.action}
            for field, array in arrays.items():
                value = np.asarray(values.get(field))
                expected = (length, *array.shape[1:])
                where = f"demonstration {i} of {name!r}: {field}"
                if value.shape != expected:
                    raise ValueError(f"{where}: got shape {list(value.shape)}, expected {list(expected)}")
                if value.dtype != np.uint8 if is_image(field) else value.dtype.kind not in "fiu":
                    wanted = "uint8 in [0, 255]" if is_image(field) else "real numbers"
                    raise ValueError(f"{where}: got {value.dtype}, expected {wanted}")
                try:
                    array[start : start + length].write(value.astype(array.dtype.numpy_dtype)).result()
                except ValueError as error:  # as TensorStore reports a full disk, too
                    raise FileError(f"{self.folder}: cannot be written: {str(error)[:300]}") from error
            start += length
        self._tasks.append(TaskInfo(name, split, tuple(lengths), tuple(has_action), family, said))


class DataSet:
    """A data set on disk, opened for reading.

    Args:
        folder: as `Writer` leaves it.

    Attributes:
        header: what it holds.

    Raises:
        ValueError: for a folder that holds no data set, or whose arrays do not fit its header.
    """

    def __init__(self, folder: str | pathlib.Path):
        self.folder = pathlib.Path(folder)
        self.header = read_header(self.folder)
        self._arrays: dict[tuple[int, str], Any] = {}

    def fingerprint(self) -> str:
        """Computes the SHA-256 of the header and of all states and actions.

        Images count by their sizes alone, and what nothing is learned from not at all: families, instructions, names.
        """
        header = dataclasses.asdict(self.header)
        for name in ("fps", "state_names", "action_names"):
            del header[name]
        if not header["class_indices"]:  # as in the fingerprints of data sets that have none
            del header["class_indices"]
        for task in header["tasks"]:
            del task["family"], task["instructions"]
        digest = hashlib.sha256(json.dumps(header).encode())
        for i in range(len(self.header.tasks)):
            for field in ("state", "action"):
                if field in _fields(self.header):
                    array = self._array(i, field)
                    check_size(f"{self.folder}: {field} of task {i}", array.shape, array.dtype.numpy_dtype.itemsize)
                    digest.update(np.ascontiguousarray(self._wait(array.read())).tobytes())
        return digest.hexdigest()

    def read(
        self, task: int, demo: int, frames: np.ndarray | None = None, fields: tuple[str, ...] = ALL_FIELDS
    ) -> Demo:
        """Reads a demonstration of a task, NumPy arrays [T, ...]; only these `frames` and `fields` if any are given."""
        return self.read_later(task, demo, frames, fields)()

    def read_later(
        self, task: int, demo: int, frames: np.ndarray | None = None, fields: tuple[str, ...] = ALL_FIELDS
    ) -> Callable[[], Demo]:
        """Starts reading a demonstration; the result is a function that waits for it and returns it."""
        info = self.header.tasks[task]
        there = set(_fields(self.header)) - ({"action"} if not info.has_action[demo] else set())
        arrays = {name: self._array(task, name) for name in _fields(self.header) if _is_wanted(name, there, fields)}
        count = info.lengths[demo] if frames is None else len(frames)
        for field, array in arrays.items():
            check_size(
                f"{self.folder}: {field} of {info.name!r}", (count, *array.shape[1:]), array.dtype.numpy_dtype.itemsize
            )
        rows = sum(info.lengths[:demo]) + (np.arange(count) if frames is None else frames)
        begun = {field: array[rows].read() for field, array in arrays.items()}

        def finish() -> Demo:
            read = {field: self._wait(future) for field, future in begun.items()}
            return Demo(from_fields(read), read.get("state"), read.get("action"))

        return finish

    def _wait(self, future: Any) -> np.ndarray:
        try:
            return future.result()
        except ValueError as error:  # a chunk is missing, or does not fit its checksum
            raise FileError(f"{self.folder}: a chunk is damaged, expected what was written: {error}") from error

    def _array(self, task: int, field: str) -> Any:
        key = (task, field)
        if key not in self._arrays:
            path = self.folder / f"{task:05d}" / field
            shape, dtype = _fields(self.header)[field]
            expected = (sum(self.header.tasks[task].lengths), *shape)
            files.refuse_links(path.parent)
            spec = {"driver": "zarr3", "kvstore": _kvstore(path), "fill_missing_data_reads": False}
            try:
                array = ts.open(spec, open=True, read=True).result()
            except ValueError as error:
                raise FileError(f"{path}: cannot be opened, expected an array of zarr: {error}") from error
            if array.shape != expected or array.dtype.numpy_dtype != dtype:
                got = f"{array.dtype.name} {list(array.shape)}"
                raise FileError(f"{path}: got {got}, expected {np.dtype(dtype).name} {list(expected)}")
            chunk = [n or 1 for n in array.chunk_layout.read_chunk.shape or ()]
            if math.prod(chunk) * np.dtype(dtype).itemsize > _MAX_CHUNK_BYTES:
                raise FileError(f"{path}: got chunks of {chunk}, expected at most {_MAX_CHUNK_BYTES >> 20} MiB")
            self._arrays[key] = array
        return self._arrays[key]


def check_size(field: str, shape: tuple[int, ...], itemsize: int) -> None:
    """Raises FileError for an array larger than MAX_BYTES, before memory is allocated for it."""
    size = itemsize * math.prod(int(n) for n in shape)
    if size > MAX_BYTES:
        raise FileError(f"{field}: got shape {list(shape)}, {size / 2**30:.3g} GiB, expected at most {MAX_BYTES >> 30}")


def spread(length: int, horizon: int) -> np.ndarray:
    """Spreads [horizon] time steps evenly over a demonstration, the first and the last among them.

    Steps are repeated where the demonstration is shorter. What was done at a step stays what was done there, so
    nothing needs to be interpolated.
    """
    return np.linspace(0, length - 1, horizon).round().astype(int)


def _fields(header: Header) -> dict[str, tuple[tuple[int, ...], Any]]:
    """Returns the shape of a time step and the type of every array."""
    fields: dict[str, tuple[tuple[int, ...], Any]] = {"action": ((header.action_size,), np.float32)}
    if header.state_size:
        fields["state"] = ((header.state_size,), np.float32)
    return fields | {name: ((*size, 3), np.uint8) for name, size in by_field(header.image_shape).items()}


def _is_wanted(name: str, there: set[str], fields: tuple[str, ...]) -> bool:
    return name in there and name.partition(".")[0] in fields


def _kvstore(path: pathlib.Path) -> dict[str, str]:
    return {"driver": "file", "path": f"{path.absolute()}/"}


def _create(path: pathlib.Path, shape: tuple[int, ...], dtype: Any) -> Any:
    frame = int(np.prod(shape[1:])) * np.dtype(dtype).itemsize
    chunk = [max(1, min(shape[0], _CHUNK_BYTES // max(frame, 1))), *shape[1:]]
    metadata = {
        "shape": list(shape),
        "data_type": np.dtype(dtype).name,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}},
        "codecs": [{"name": "bytes"}, {"name": "zstd", "configuration": {"level": 1}}, {"name": "crc32c"}],
    }
    spec = {"driver": "zarr3", "kvstore": _kvstore(path), "metadata": metadata, "store_data_equal_to_fill_value": True}
    return ts.open(spec, create=True).result()


def _write_group(folder: pathlib.Path, attributes: dict[str, Any]) -> None:
    files.write_json(folder / "zarr.json", {**_GROUP, "attributes": attributes})
