"""Writes a data set as one of LeRobot's (version 3), with images as PNG: python -m milx.data.to_lerobot SET OUT.

An episode's task is what was said to be done in it, or else the name of its task. Names of tasks, splits and families
are kept in files of `meta/` whose names begin with milx, and the command that leads back with them is printed. The
training tasks come first, then those for validation and test, as `splits` in `meta/info.json` says.
"""

import io
import json
import pathlib
import shlex
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from absl import app, flags
from PIL import Image
from rich.progress import track

from milx.core import files
from milx.core.commands import command
from milx.data.dataset import DataSet
from milx.data.header import Header
from milx.types import SPLITS, Demo, by_field

_DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_FILE_BYTES = 100 << 20
_FILES_IN_CHUNK = 1000
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_STATISTICS = "min", "max", "mean", "std", "count", *_QUANTILES
_PICTURES = 100
"""Images of an episode that its statistics are about, at most."""
_COUNTERS = {"timestamp": "float32"} | dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64")


class Episode(NamedTuple):
    """An episode: its task's number in the data set, its number there, and what was said to be done."""

    task: int
    demo: int
    said: str


def write(data: DataSet, out: pathlib.Path, fps: float) -> None:
    """Writes a data set in LeRobot's format.

    Args:
        data: what to write.
        out: the folder; must not exist.
        fps: time steps in a second.

    Raises:
        ValueError: if the folder exists, or a demonstration shows no actions, which LeRobot has no room for.
    """
    if out.exists():
        raise ValueError(f"out: {out} exists, expected a folder that does not: nothing is written over")
    episodes = _episodes(data)
    said = sorted({episode.said for episode in episodes})
    rows: list[dict[str, Any]] = []
    names, batches, size, file = {}, [], 0, 0
    with files.creating(out) as partial:
        for number, episode in enumerate(track(episodes, "writing episodes")):
            info = data.header.tasks[episode.task]
            demo = data.read(episode.task, episode.demo)
            start = rows[-1]["dataset_to_index"] if rows else 0
            _check_finite(demo, f"demonstration {episode.demo} of task {episode.task} ({info.name!r})")
            columns = _columns(demo, number, start, said.index(episode.said), fps)
            table = _table(columns, demo)
            where = {"chunk_index": file // _FILES_IN_CHUNK, "file_index": file % _FILES_IN_CHUNK}
            rows.append(
                {"episode_index": number, "tasks": [episode.said], "length": info.lengths[episode.demo]}
                | {f"data/{name}": value for name, value in where.items()}
                | {"dataset_from_index": start, "dataset_to_index": start + info.lengths[episode.demo]}
                | {f"stats/{name}": value for name, value in _flat(_statistics(columns)).items()}
                | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
            )
            names[str(number)] = info.name
            batches.append(table)
            size += table.nbytes
            if size >= _FILE_BYTES or number == len(episodes) - 1:
                _write_table(partial / _DATA_PATH.format(**where), batches)
                batches, size, file = [], 0, file + 1
        _write_meta(partial / "meta", data, rows, said, names, fps)


def _episodes(data: DataSet) -> list[Episode]:
    found = []
    for split in SPLITS:
        for task in data.header.of_split(split):
            info = data.header.tasks[task]
            for demo, has_action in enumerate(info.has_action):
                if not has_action:
                    where = f"demonstration {demo} of task {task} ({info.name!r})"
                    raise ValueError(f"{where}: shows no actions, expected some: LeRobot has no room for that")
                said = info.instructions[demo] if info.instructions else ""
                found.append(Episode(task, demo, said or info.name))
    if not found:
        raise ValueError(f"{data.folder}: has no demonstrations, expected at least one")
    return found


def _check_finite(demo: Demo, where: str) -> None:
    for field, value in (("state", demo.state), ("action", demo.action)):
        if value is not None and not np.isfinite(value).all():
            raise ValueError(f"{where}: {field}: got values that are not finite, expected numbers that JSON can hold")


def _cameras(image: Any) -> dict[str, Any]:
    """Names images as LeRobot does: observation.image, or observation.images.NAME."""
    return {f"observation.{name.replace('image.', 'images.', 1)}": each for name, each in by_field(image).items()}


def _columns(demo: Demo, number: int, start: int, task: int, fps: float) -> dict[str, np.ndarray]:
    """Returns an episode's arrays by feature."""
    length = len(demo.action)
    frame = np.arange(length)
    counters = frame / fps, frame, np.full(length, number), start + frame, np.full(length, task)
    vectors = {"observation.state": demo.state, "action": demo.action}
    found = {name: value for name, value in vectors.items() if value is not None} | _cameras(demo.image)
    types = zip(_COUNTERS.items(), counters, strict=True)
    return found | {name: np.asarray(value, dtype) for (name, dtype), value in types}


def _table(columns: dict[str, np.ndarray], demo: Demo) -> Any:
    import pyarrow

    pictures, arrays = _cameras(demo.image), {}
    for name, value in columns.items():
        if name in pictures:
            encoded = [{"bytes": _png(image), "path": f"frame-{i:06d}.png"} for i, image in enumerate(value)]
            kind = pyarrow.struct([("bytes", pyarrow.binary()), ("path", pyarrow.string())])
            arrays[name] = pyarrow.array(encoded, kind)
        elif value.ndim == 1 or value.shape[1] == 1:  # LeRobot takes vectors with one entry for numbers
            arrays[name] = pyarrow.array(value.ravel())
        else:
            arrays[name] = pyarrow.FixedSizeListArray.from_arrays(pyarrow.array(value.ravel()), value.shape[1])
    known = {"info": {"features": {name: _feature(value) for name, value in columns.items()}}}
    return pyarrow.table(arrays).replace_schema_metadata({"huggingface": json.dumps(known)})


def _feature(value: np.ndarray) -> dict[str, Any]:
    """Describes a column as the package datasets does."""
    if value.ndim == 4:
        return {"_type": "Image"}
    one = {"dtype": str(value.dtype), "_type": "Value"}
    return (
        one if value.ndim == 1 or value.shape[1] == 1 else {"feature": one, "length": value.shape[1], "_type": "List"}
    )


def _png(image: np.ndarray) -> bytes:
    out = io.BytesIO()
    Image.fromarray(image).save(out, "PNG")
    return out.getvalue()


def _statistics(columns: dict[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """Computes an episode's statistics, of images by channel [3, 1, 1] in [0, 1]."""
    found = {}
    for name, value in columns.items():
        rows = value.reshape(len(value), -1)
        shape: tuple[int, ...] = (-1,)
        if value.ndim == 4:
            few = value[np.linspace(0, len(value) - 1, min(len(value), _PICTURES)).round().astype(int)]
            rows, shape = few.reshape(-1, 3) / 255.0, (3, 1, 1)
        moments = rows.min(axis=0), rows.max(axis=0), rows.mean(axis=0), rows.std(axis=0)
        quantiles = np.quantile(rows, list(_QUANTILES.values()), axis=0)
        one = {key: x.reshape(shape) for key, x in zip(("min", "max", "mean", "std"), moments, strict=True)}
        one |= {key: x.reshape(shape) for key, x in zip(_QUANTILES, quantiles, strict=True)}
        found[name] = one | {"count": np.array([len(value)])}
    return found


def _flat(statistics: dict[str, dict[str, np.ndarray]]) -> dict[str, Any]:
    return {f"{name}/{key}": one[key].tolist() for name, one in statistics.items() for key in _STATISTICS}


def _joined(rows: list[dict[str, Any]], name: str) -> dict[str, list]:
    """Joins the statistics of all episodes; quantiles are averaged over time steps, as LeRobot does."""
    of = {key: np.array([row[f"stats/{name}/{key}"] for row in rows], float) for key in _STATISTICS}
    weight = of["count"].reshape(-1, *[1] * (of["mean"].ndim - 1)) / of["count"].sum()
    mean = (weight * of["mean"]).sum(axis=0)
    variance = (weight * (of["std"] ** 2 + (of["mean"] - mean) ** 2)).sum(axis=0)
    found = {"min": of["min"].min(axis=0), "max": of["max"].max(axis=0), "mean": mean, "std": np.sqrt(variance)}
    found["count"] = of["count"].sum(axis=0).astype(int)
    found |= {key: (weight * of[key]).sum(axis=0) for key in _QUANTILES}
    return {key: value.tolist() for key, value in found.items()}


def _write_meta(
    folder: pathlib.Path, data: DataSet, rows: list[dict], said: list[str], names: dict[str, str], fps: float
) -> None:
    import pyarrow

    head = data.header
    _write_table(folder / "tasks.parquet", [_tasks(said)])
    _write_table(folder / "episodes" / "chunk-000" / "file-000.parquet", [pyarrow.Table.from_pylist(rows)])
    features = dict(_described(data))
    files.write_json(folder / "stats.json", {name: _joined(rows, name) for name in features})
    files.write_json(folder / "milx_tasks.json", names)
    of_split = lambda split: [head.tasks[task].name for task in head.of_split(split)]  # noqa: E731
    files.write_json(folder / "milx_splits.json", {split: of_split(split) for split in SPLITS[1:]})
    files.write_json(folder / "milx_families.json", {task.name: task.family for task in head.tasks})
    ends, splits = 0, {}
    for split in SPLITS:
        count = sum(len(head.tasks[task].lengths) for task in head.of_split(split))
        if count:
            splits[split] = f"{ends}:{ends + count}"
        ends += count
    info: dict[str, Any] = {"codebase_version": "v3.0", "robot_type": None, "total_episodes": len(rows)}
    info |= {"total_frames": rows[-1]["dataset_to_index"], "total_tasks": len(said), "chunks_size": _FILES_IN_CHUNK}
    info |= {"data_files_size_in_mb": _FILE_BYTES >> 20, "video_files_size_in_mb": 200, "fps": fps, "splits": splits}
    info |= {"data_path": _DATA_PATH, "video_path": None, "features": features}
    files.write_json(folder / "info.json", info)


def _tasks(said: list[str]) -> Any:
    """Makes the table of tasks, whose index pandas takes from the metadata."""
    import pyarrow

    index, keys = "__index_level_0__", ("name", "field_name", "pandas_type", "numpy_type")
    kinds = ("task_index", "task_index", "int64", "int64"), (None, index, "unicode", "str")
    columns = [dict(zip(keys, kind, strict=True)) | {"metadata": None} for kind in kinds]
    known = {"index_columns": [index], "column_indexes": [], "columns": columns, "pandas_version": "2.0.0"}
    table = pyarrow.table({"task_index": range(len(said)), index: said})
    return table.replace_schema_metadata({"pandas": json.dumps(known)})


def way_back(head: Header, out: pathlib.Path) -> str:
    """Writes the command that imports what `write` has written, with its names, splits and families."""
    meta, state = out / "meta", "observation.state" if head.state_size else ""
    words = [f"--camera={','.join(_cameras(head.image_shape))}", f"--state={state}"]
    kept = {"task": "tasks", "splits": "splits", "family": "families"}
    words += [f"--{flag}={meta / f'milx_{name}.json'}" for flag, name in kept.items()]
    words += [f"--height={max((size[0] for size in by_field(head.image_shape).values()), default=1)}"]
    if head.class_indices:
        words.append(f"--classes={','.join(map(str, head.class_indices))}")
    return shlex.join(["python", "-m", "milx.data.lerobot", str(out), "SET", *words])


def _described(data: DataSet) -> Iterator[tuple[str, dict[str, Any]]]:
    """Describes all features, in the order of the columns."""
    head = data.header
    for name, size, entries in (
        ("observation.state", head.state_size, head.state_names),
        ("action", head.action_size, head.action_names),
    ):
        if size:
            yield name, {"dtype": "float32", "shape": [size], "names": list(entries) or None}
    for name, shape in _cameras(head.image_shape).items():
        yield name, {"dtype": "image", "shape": [*shape, 3], "names": ["height", "width", "channels"]}
    for name, dtype in _COUNTERS.items():
        yield name, {"dtype": dtype, "shape": [1], "names": None}


def _write_table(path: pathlib.Path, tables: list[Any]) -> None:
    import pyarrow
    import pyarrow.parquet

    out = pyarrow.BufferOutputStream()
    pyarrow.parquet.write_table(pyarrow.concat_tables(tables), out)
    files.write_bytes(path, out.getvalue().to_pybytes())


def main(argv: list[str]) -> None:
    """Writes SET as OUT."""
    if len(argv) != 3:
        raise app.UsageError("expected two arguments, SET and OUT")
    with command():
        data = DataSet(argv[1])
        fps = flags.FLAGS.fps or data.header.fps
        if fps is None:
            raise ValueError("fps: the data set does not say it, expected --fps")
        write(data, pathlib.Path(argv[2]), fps)
        back = way_back(data.header, pathlib.Path(argv[2]))
        print(f"{argv[2]}: a LeRobot data set of version 3; the way back is\n{back}")


if __name__ == "__main__":
    flags.DEFINE_float("fps", None, "Time steps in a second; those of the data set if not given.", lower_bound=0.001)
    app.run(main)
