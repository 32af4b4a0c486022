"""Data sets written in LeRobot's format, beside what LeRobot itself wrote of the same episodes."""

import dataclasses
import json
import pathlib
import shlex
import subprocess
import sys

import jax
import numpy as np
import pyarrow.parquet
import pytest

from milx.data import episodes, to_lerobot
from milx.data.dataset import DataSet, Writer
from milx.data.lerobot import LeRobot

ROOT = pathlib.Path(__file__).parents[1] / "fixtures" / "lerobot"
CAMERAS = "observation.images.top,observation.images.wrist"


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Imports what LeRobot wrote, and writes it again."""
    folder = tmp_path_factory.mktemp("lerobot")
    source = LeRobot(ROOT, CAMERAS, "observation.state", "action", 128)
    episodes.write(folder / "set", source.episodes("task_index"), source.contents, (0.3, 0.3), "there")
    data = DataSet(folder / "set")
    to_lerobot.write(data, folder / "out", data.header.fps)
    return data, folder / "out"


def test_what_is_written_is_imported_bit_for_bit(written, tmp_path):
    data, out = written
    source = LeRobot(out, CAMERAS, "observation.state", "action", 128)
    found = source.episodes(str(out / "meta" / "milx_tasks.json"))
    assert source.contents == LeRobot(ROOT, CAMERAS, "observation.state", "action", 128).contents
    order = [i for split in ("train", "validation", "test") for i in data.header.of_split(split)]
    pairs = [(task, demo) for task in order for demo in range(len(data.header.tasks[task].lengths))]
    assert len(found) == len(pairs) == 9
    for episode, (task, number) in zip(found, pairs, strict=True):
        demo, expected = episode.read(), data.read(task, number)
        assert (episode.task, episode.instruction) == (data.header.tasks[task].name,) * 2
        np.testing.assert_array_equal(demo.state, expected.state)
        np.testing.assert_array_equal(demo.action, expected.action)
        for name, image in expected.image.items():
            np.testing.assert_array_equal(demo.image[name], image)


def read(path):
    return pyarrow.parquet.read_table(path)


def test_names_and_types_are_those_that_lerobot_writes(written):
    """Compares with the files of its own writer, apart from the camera that is a video there."""
    _, out = written
    mine, theirs = (read(folder / "data/chunk-000/file-000.parquet").schema for folder in (out, ROOT))
    assert [field for field in mine if "top" not in field.name] == list(theirs)
    mine, theirs = (read(folder / "meta/episodes/chunk-000/file-000.parquet").schema for folder in (out, ROOT))
    named = lambda schema: {field.name: field.type for field in schema if not field.name.startswith("videos")}  # noqa: E731
    assert set(named(mine)) == set(named(theirs))
    vague = ("task_index", "episode_index", "index", "frame_index")  # their extremes are whole numbers there
    for name, kind in named(theirs).items():
        if not name.startswith(tuple(f"stats/{field}/m" for field in vague)):
            assert str(named(mine)[name]).replace("item", "element") == str(kind).replace("item", "element"), name
    mine, theirs = (json.loads((folder / "meta/info.json").read_text()) for folder in (out, ROOT))
    assert set(mine) == set(theirs)
    for name, feature in theirs["features"].items():
        if "top" not in name:
            assert mine["features"][name] == feature
    assert mine["splits"] == {"train": "0:3", "validation": "3:6", "test": "6:9"}
    mine, theirs = (read(folder / "meta/tasks.parquet") for folder in (out, ROOT))
    assert mine.to_pylist() == theirs.to_pylist()
    mine, theirs = (json.loads(table.schema.metadata[b"pandas"]) for table in (mine, theirs))
    assert mine["index_columns"] == theirs["index_columns"], "by which pandas finds the sentences"
    assert mine["columns"][0] == theirs["columns"][0]
    assert mine["columns"][1]["field_name"] == theirs["columns"][1]["field_name"]


def test_statistics_are_those_of_all_episodes(written):
    """Compares with NumPy over all time steps, and with what LeRobot computed.

    Its quantiles are approximate, and its standard deviations of images are those within an image.
    """
    data, out = written
    mine, theirs = (json.loads((folder / "meta/stats.json").read_text()) for folder in (out, ROOT))
    assert set(mine) == set(theirs)
    for name in ("observation.state", "action", "observation.images.wrist"):
        for key in ("min", "max", "mean", "std", "count"):
            if "images" not in name or key != "std":
                np.testing.assert_allclose(mine[name][key], theirs[name][key], rtol=1e-5, atol=1e-6)
    all_actions = np.concatenate([data.read(task, demo).action for task in range(3) for demo in range(3)])
    np.testing.assert_allclose(mine["action"]["std"], all_actions.std(axis=0), rtol=1e-5)
    rows = read(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    action = data.read(data.header.of_split("train")[0], 0).action
    np.testing.assert_allclose(rows[0]["stats/action/q90"], np.quantile(action, 0.9, axis=0), rtol=1e-6)


def test_the_command_that_leads_back_does(written, tmp_path):
    """Runs it, and compares everything but where the demonstrations come from."""
    data, out = written
    command = shlex.split(to_lerobot.way_back(data.header, out))
    words = [word if word != "SET" else str(tmp_path / "again") for word in command]
    done = subprocess.run([sys.executable, *words[1:]], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    again = DataSet(tmp_path / "again")
    assert dataclasses.replace(again.header, source=data.header.source) == data.header
    for task, info in enumerate(data.header.tasks):
        for demo in range(len(info.lengths)):
            jax.tree.map(np.testing.assert_array_equal, again.read(task, demo), data.read(task, demo))


def test_vectors_of_one_entry_are_numbers_and_who_says_nothing_says_its_task(tmp_path):
    with Writer(tmp_path / "set", None, 1, 1) as writer:
        demos = [episodes.Demo(None, np.full((4, 1), i), np.full((4, 1), -i)) for i in range(2)]
        writer.add("a", "train", [4, 4], demos, instructions=["", "do it"])
    to_lerobot.write(DataSet(tmp_path / "set"), tmp_path / "out", 10)
    table = read(tmp_path / "out" / "data/chunk-000/file-000.parquet")
    assert str(table.schema.field("action").type) == "float"
    assert table["action"].to_pylist() == [0.0] * 4 + [-1.0] * 4
    assert read(tmp_path / "out" / "meta/tasks.parquet")["__index_level_0__"].to_pylist() == ["a", "do it"]


def test_what_lerobot_has_no_room_for_is_refused(tmp_path):
    with Writer(tmp_path / "set", None, 2, 2) as writer:
        demo = episodes.Demo(None, np.zeros((4, 2)), np.zeros((4, 2)))
        writer.add("a", "train", [4, 4], [demo, dataclasses.replace(demo, action=None)])
    with pytest.raises(ValueError, match=r"demonstration 1 of task 0 \('a'\): shows no actions"):
        to_lerobot.write(DataSet(tmp_path / "set"), tmp_path / "out", 10)
    assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match=r"out: .* exists"):
        to_lerobot.write(DataSet(tmp_path / "set"), tmp_path / "set", 10)
