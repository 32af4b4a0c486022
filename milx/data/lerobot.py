"""Imports a LeRobot data set (version 3: parquet and MP4); neither LeRobot nor PyTorch is needed.

    python -m milx.data.lerobot PATH OUT --camera=observation.images.top
    python -m milx.data.lerobot PATH OUT --camera=observation.images.wrist,observation.images.scene
    python -m milx.data.lerobot PATH OUT --state=observation.state --action=action --task=tasks.json

PATH is the data set's folder, the one with meta/ and data/. A task is what the episodes say (--task=task_index), a data
file (--task=file), or what a JSON file says that maps the numbers of episodes to names of tasks.
"""

import functools
import io
import pathlib
import re
import shlex
from collections.abc import Iterator
from typing import Any

import numpy as np
from absl import app
from PIL import Image

from milx.core import files
from milx.data import cameras, command_line
from milx.data.dataset import check_size
from milx.data.episodes import Contents, Episode
from milx.data.mapping import lookup, read_mapping
from milx.types import Demo, by_field

_IMAGES, _NUMBERS = ("video", "image"), ("float32", "float64", "int64")
_CONVERTER = "python -m lerobot.datasets.v30.convert_dataset_v21_to_v30"
"""The one of LeRobot 0.4, which looks for ROOT/REPO_ID; later versions have moved it."""
_BATCH_BYTES = 1 << 30
_PLACEHOLDER = re.compile(r"\{(\w+)(?::0?(\d)d)?\}")


class LeRobot:
    """A data set of LeRobot's version 3, opened for reading.

    Args:
        root: its folder.
        camera: the feature that holds images, or several separated by commas; "" for none, None for the only one.
        state: the features that together are the robot's state, separated by commas; "" for none.
        action: the feature that holds actions; "" for none.
        height: maximum number of rows of an image; larger ones are shrunk.

    Raises:
        ValueError: for another version (the message names LeRobot's converter), a feature that does not exist or does
            not fit, or files that are missing, damaged or outside the folder.
    """

    def __init__(self, root: str | pathlib.Path, camera: str | None, state: str, action: str, height: int):
        self.root = pathlib.Path(root)
        self.info = self._read_info()
        self.cameras = cameras.named(self._only_camera() if camera is None else camera)
        self.vectors = {"state": [name for name in state.split(",") if name], "action": [action] if action else []}
        image_shape = cameras.joined(
            {name: cameras.shrunk(self._shape(key, _IMAGES, 3), height) for name, key in self.cameras.items()}
        )
        names = {field: sum((self._names(key) for key in keys), ()) for field, keys in self.vectors.items()}
        sizes = len(names["state"]), len(names["action"])
        self.contents = Contents(image_shape, *sizes, self.info["fps"], names["state"], names["action"])

    def episodes(self, task: str) -> list[Episode]:
        """Lists all episodes.

        Args:
            task: "task_index", "file", or the path of a JSON file.
        """
        mapping = None if task in ("task_index", "file") else read_mapping(task, "task")
        found = []
        for row in self._rows():
            number, file = row["episode_index"], self._data_file(row)
            if mapping is not None:
                name = lookup(mapping, str(number), task, "task")
            else:
                name = file.relative_to(self.root).as_posix() if task == "file" else str(row["tasks"][0])
            read = functools.partial(self._read, row, file)
            found.append(
                Episode(str(number), name, row["length"], bool(self.vectors["action"]), read, str(row["tasks"][0]))
            )
        return found

    def _read(self, row: dict[str, Any], file: pathlib.Path) -> Demo:
        length, number = row["length"], row["episode_index"]
        pictures = [key for key in self.cameras.values() if not self._is_video(key)]
        columns = ("episode_index", *self.vectors["state"], *self.vectors["action"], *pictures)
        table = _read_table(file, tuple(dict.fromkeys(columns)))
        kept = np.flatnonzero(table["episode_index"].to_numpy() == number)
        if len(kept) != length:
            raise ValueError(f"{file}: got {len(kept)} rows of episode {number}, expected {length}")

        def vector(name: str) -> np.ndarray:
            values, size = table[name].take(kept).to_pylist(), len(self._names(name))
            try:
                return np.array(values, np.float32).reshape(length, size)
            except (ValueError, TypeError) as error:
                raise ValueError(
                    f"{file}: {name} of episode {number}: expected {size} numbers a row ({error})"
                ) from error

        def images(key: str, shape: tuple[int, int]) -> np.ndarray:
            check_size(f"{key} of episode {number}", (length, *shape, 3), 1)
            frames = self._video(row, key) if self._is_video(key) else _images(file, table[key].take(kept).to_pylist())
            return np.stack(list(cameras.resized(frames, shape)))

        found = {name: [vector(key) for key in keys] for name, keys in self.vectors.items()}
        state, action = (np.concatenate(values, axis=1) if values else None for values in found.values())
        shapes = by_field(self.contents.image_shape).values()
        seen = {name: images(key, shape) for (name, key), shape in zip(self.cameras.items(), shapes, strict=True)}
        return Demo(cameras.joined(seen), state, action)

    def _is_video(self, camera: str) -> bool:
        return self.info["features"][camera]["dtype"] == "video"

    def _video(self, row: dict[str, Any], camera: str) -> Iterator[np.ndarray]:
        """Reads the episode's part of a camera's video file."""
        prefix = f"videos/{camera}"
        values = {"video_key": camera}
        values |= {name: row[f"{prefix}/{name}"] for name in ("chunk_index", "file_index")}
        file = files.inside(self.root, _fill(self.info["video_path"], values))
        yield from read_video(file, row[f"{prefix}/from_timestamp"], row["length"], self.info["fps"])

    def _rows(self) -> list[dict[str, Any]]:
        """Reads what meta/episodes says of every episode, in order."""
        columns = ["episode_index", "tasks", "length", "data/chunk_index", "data/file_index"]
        for camera in filter(self._is_video, self.cameras.values()):
            prefix = f"videos/{camera}"
            columns += [f"{prefix}/chunk_index", f"{prefix}/file_index", f"{prefix}/from_timestamp"]
        rows = []
        for path in sorted((self.root / "meta" / "episodes").glob("*/*.parquet")):
            rows += _read_table(files.inside(self.root, path.relative_to(self.root)), tuple(columns)).to_pylist()
        if not rows:
            raise ValueError(f"{self.root}: meta/episodes is empty, expected episodes")
        for row in rows:
            self._check_row(row)
        return sorted(rows, key=lambda row: row["episode_index"])

    def _check_row(self, row: dict[str, Any]) -> None:
        """Raises ValueError for an entry of meta/episodes that cannot be."""
        where = f"{self.root}: episode {row['episode_index']!r:.20}"
        for name, value in row.items():
            if name == "tasks":
                good, expected = isinstance(value, list) and len(value) > 0, "at least one"
            elif name.endswith("timestamp"):
                good, expected = isinstance(value, float) and 0 <= value < 1e7, "seconds, at least 0"
            else:
                least = 1 if name == "length" else 0
                good, expected = (
                    isinstance(value, int) and least <= value < 1 << 40,
                    f"a whole number, at least {least}",
                )
            if not good:
                raise ValueError(f"{where}: {name}: got {value!r:.100}, expected {expected}")

    def _data_file(self, row: dict[str, Any]) -> pathlib.Path:
        values = {name: row[f"data/{name}"] for name in ("chunk_index", "file_index")}
        return files.inside(self.root, _fill(self.info["data_path"], values))

    def _read_info(self) -> dict[str, Any]:
        path = self.root / "meta" / "info.json"
        if not path.is_file():
            raise ValueError(f"{self.root} has no meta/info.json, expected a LeRobot data set")
        try:
            info = files.read_json(files.inside(self.root, "meta/info.json"))
            version = str(info["codebase_version"])
            features, fps = info["features"], info["fps"]
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"{path}: expected LeRobot's metadata: {error!r}") from error
        if version == "v2.1":
            folder = self.root.resolve()
            where = f"--repo-id={shlex.quote(folder.name)} --root={shlex.quote(str(folder.parent))} --push-to-hub=false"
            command = f"{_CONVERTER} {where}"
            how = f"LeRobot 0.4 converts it: `{command}`"
            raise ValueError(f"{path}: codebase_version: got {version}, expected v3.0; {how}")
        if not version.startswith("v3"):
            raise ValueError(f"{path}: codebase_version: got {version}, expected v3.0")
        if not isinstance(features, dict) or not isinstance(fps, int | float) or not 0 < fps < 10_000:
            raise ValueError(f"{path}: features or fps: expected what LeRobot writes")
        for name, feature in features.items():
            there = isinstance(feature, dict) and isinstance(feature.get("dtype"), str)
            if not there or not isinstance(feature.get("shape"), list):
                raise ValueError(f"{path}: features.{name}: got {feature!r:.200}, expected a dtype and a shape")
        for field in ("data_path", "video_path"):
            needed = field == "data_path" or any(feature["dtype"] == "video" for feature in features.values())
            if needed and not isinstance(info.get(field), str):
                raise ValueError(f"{path}: {field}: got {info.get(field)!r:.200}, expected a path")
        return info

    def _only_camera(self) -> str:
        found = [name for name, feature in self.info["features"].items() if feature["dtype"] in _IMAGES]
        if len(found) > 1:
            raise ValueError(f"camera: expected one or several of {','.join(found)}, or none with --camera=")
        return found[0] if found else ""

    def _names(self, feature: str) -> tuple[str, ...]:
        """Names the entries of a vector, by number if the data set does not name them."""
        size, short = self._shape(feature, _NUMBERS, 1)[0], feature.rpartition(".")[2]
        names = self.info["features"][feature].get("names")
        if isinstance(names, dict) and len(names) == 1:  # {"motors": [...]}
            (names,) = names.values()
        good = isinstance(names, list) and len(names) == size and all(isinstance(name, str) for name in names)
        return tuple(names) if good else tuple(f"{short}.{i}" for i in range(size))

    def _shape(self, name: str, dtypes: tuple[str, ...], axes: int) -> tuple[int, ...]:
        features = self.info["features"]
        if name not in features:
            raise ValueError(f"feature: got {name!r}, expected one of {', '.join(features)}")
        dtype, shape = features[name].get("dtype"), tuple(features[name].get("shape", ()))
        if dtype not in dtypes or len(shape) != axes or not all(isinstance(n, int) and n > 0 for n in shape):
            expected = f"{' or '.join(dtypes)} with {axes} axes"
            raise ValueError(f"feature {name!r}: got {dtype} {list(shape)}, expected {expected}")
        if axes == 3 and shape[0] == 3 and shape[2] != 3:  # channels first
            shape = (*shape[1:], 3)
        if axes == 3 and shape[2] != 3:
            raise ValueError(f"feature {name!r}: got {list(shape)}, expected images with 3 channels")
        return shape


def read_video(file: pathlib.Path, start: float, count: int, fps: float) -> Iterator[np.ndarray]:
    """Reads `count` frames [H, W, 3] uint8 of a video, from `start` (s) on, 1/fps apart.

    Raises:
        ValueError: if the file is no video, or has no frame at one of those times.
    """
    try:
        import av
    except ImportError as error:
        raise ValueError("reading videos needs the package av: install milx with the extra 'lerobot'") from error
    wanted = 0
    try:
        # A path such as "file:/etc/x.mp4" would be a protocol of FFmpeg's if it were not absolute.
        with av.open(str(file.absolute()), format="mp4") as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            container.seek(int(start * av.time_base))
            for frame in container.decode(stream):
                # Frames are taken by their times: a seek goes to the key frame before.
                while wanted < count and abs(float(frame.time or 0.0) - (start + wanted / fps)) < 0.5 / fps:
                    yield frame.to_ndarray(format="rgb24")
                    wanted += 1
                if wanted == count:
                    return
    except Exception as error:  # besides FFmpeg's errors, those of metadata that are no text
        raise ValueError(f"{file}: expected a video that can be read: {error}") from error
    raise ValueError(f"{file}: expected a frame at {start + wanted / fps:.3f} s, there is none")


def _images(file: pathlib.Path, values: list[Any]) -> Iterator[np.ndarray]:
    for value in values:
        try:
            yield np.asarray(Image.open(io.BytesIO(value["bytes"]), formats=("PNG", "JPEG")).convert("RGB"))
        except (OSError, TypeError, KeyError, Image.DecompressionBombError) as error:
            raise ValueError(f"{file}: expected an image that can be read: {error}") from error


def _fill(template: Any, values: dict[str, Any]) -> str:
    """Fills numbers and names into a path in place of {name} and {name:03d}; nothing else is understood."""

    def replace(match: re.Match[str]) -> str:
        name, width = match.groups()
        if name not in values:
            raise ValueError(f"path {template!r}: got {{{name}}}, expected {', '.join(values)}")
        return str(values[name]).zfill(int(width or 0))

    return _PLACEHOLDER.sub(replace, str(template))


@functools.lru_cache(maxsize=2)
def _read_table(file: pathlib.Path, columns: tuple[str, ...]) -> Any:
    """Reads columns of a parquet file, "episode_index" among them, unless they are missing or too large."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise ValueError("reading LeRobot data needs pyarrow: install milx with the extra 'lerobot'") from error
    try:
        metadata = pyarrow.parquet.read_metadata(file)
        if missing := sorted(set(columns) - set(metadata.schema.to_arrow_schema().names)):
            raise ValueError(f"{file}: has no column {missing[0]!r}, expected {', '.join(columns)}")
        groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
        parts = [group.column(i) for group in groups for i in range(group.num_columns)]
        wanted = [part for part in parts if part.path_in_schema.startswith(columns)]
        check_size(str(file), (sum(max(part.total_uncompressed_size, 8 * part.num_values) for part in wanted),), 1)
        # A value that is stored once and meant a million times is as large as a million: so few rows at once.
        largest = max((part.total_uncompressed_size for part in wanted if part.has_dictionary_page), default=1)
        rows, batches = min(max(_BATCH_BYTES // max(largest, 1), 1), 4096), []
        source = pyarrow.parquet.ParquetFile(file)
        for batch in source.iter_batches(rows, columns=list(columns)):
            batches.append(batch)
            check_size(str(file), (sum(each.nbytes for each in batches),), 1)
        table = pyarrow.Table.from_batches(batches) if batches else source.read(list(columns))
        if not pyarrow.types.is_integer(numbers := table["episode_index"].type):
            raise ValueError(f"{file}: episode_index: got {numbers}, expected whole numbers")
        return table
    except (pyarrow.ArrowException, OSError) as error:
        raise ValueError(f"{file}: expected a parquet file that can be read: {error}") from error


def main(argv: list[str]) -> None:
    """Imports PATH as OUT."""
    command_line.run(argv, lambda path, flags: LeRobot(path, flags.camera, flags.state, flags.action, flags.height))


if __name__ == "__main__":
    command_line.define_flags(state="observation.state", action="action", task="task_index")
    app.run(main)
