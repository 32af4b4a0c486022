"""Demonstrations that a world shows itself, recorded as a data set."""

import functools
import pathlib
import sys

import numpy as np
import pytest

from milx.data.dataset import DataSet
from milx.types import Demo
from milx.worlds import record
from milx.worlds.client import Client, WorldError

WORLDS = pathlib.Path(__file__).parents[1] / "fixtures" / "worlds"
sys.path.insert(0, str(WORLDS))
import point_world  # noqa: E402

NAMES = sorted(point_world.GOALS)
SPLITS = dict(zip(NAMES, ("train", "train", "validation", "test"), strict=True))
FAMILIES = {name: name.partition("/")[0] for name in NAMES}


@pytest.fixture(autouse=True)
def folder(monkeypatch):
    monkeypatch.chdir(WORLDS)


def connect(name="make"):
    return functools.partial(Client, f"point_world:{name}", sys.executable, 60.0)


def test_what_is_recorded_is_what_the_world_shows(tmp_path):
    client = connect()()
    assert sorted(client.ask({"do": "tasks"})[0]["tasks"]) == NAMES
    client.close()
    recorded = record.record(connect(), NAMES, demos=3, workers=2)
    record.write(tmp_path / "set", recorded, SPLITS, FAMILIES, 3, 128, "a test")
    data = DataSet(tmp_path / "set")
    assert data.header.fps == 12
    assert [(task.name, task.split, task.family) for task in data.header.tasks] == [
        (name, SPLITS[name], FAMILIES[name]) for name in NAMES
    ]
    for number, name in enumerate(NAMES):
        for seed in range(3):
            shown, read = point_world.PointWorld(name).demonstrate(seed), data.read(number, seed)
            for field, expected in shown.items():
                np.testing.assert_array_equal(getattr(read, field), expected.astype(np.float32))


def test_demonstrations_that_fail_are_replaced_and_tasks_that_cannot_be_shown_left_out(tmp_path, capsys):
    """Even seeds end the world's process, odd ones do not, and one task fails with every seed."""
    recorded = record.record(connect("make_frail"), NAMES, demos=2, workers=2)
    record.write(tmp_path / "set", recorded, SPLITS, FAMILIES, 2, 128, "a test")
    data = DataSet(tmp_path / "set")
    assert [task.name for task in data.header.tasks] == [name for name in NAMES if name != "far/right"]
    shown = point_world.PointWorld("far/left").demonstrate(13)["state"].astype(np.float32)
    np.testing.assert_array_equal(data.read(0, 1).state, shown)
    said = capsys.readouterr().err
    assert said.startswith("milx: far/right is left out, 0 of 2 demonstrations: point_world:make_frail: ")
    assert "nobody can show this" in said


def test_larger_pictures_are_shrunk(tmp_path):
    """Halves a picture whose rows are as bright as their numbers: two rows have their mean."""
    image = np.broadcast_to(np.arange(40, dtype=np.uint8)[:, None, None], (12, 40, 60, 3))
    demo = Demo(image, None, np.zeros((12, 2)))
    record.write(tmp_path / "set", iter([record.Recorded("a", [demo], "")]), {"a": "train"}, {"a": ""}, 1, 20, "a test")
    read = DataSet(tmp_path / "set").read(0, 0).image
    np.testing.assert_allclose(read, image[:, ::2, ::2] + 0.5, atol=0.51)


def test_nothing_to_record_is_an_error(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="a test: no task could be shown 1 times, expected at least one"):
        record.write(tmp_path / "set", iter(()), SPLITS, FAMILIES, 1, 20, "a test")
    (tmp_path / "plain_world.py").write_text("def make(task):\n    return None\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(WorldError, match="tasks: missing, expected a function of this name"):
        Client("plain_world:make", sys.executable, 60.0).ask({"do": "tasks"})


def test_an_error_of_another_kind_ends_the_recording(monkeypatch):
    """Fails to start a world in an unexpected way, then gets demonstrations without actions: no world is left."""

    def fail():
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        list(record.record(fail, NAMES, demos=1, workers=2))
    started = []
    monkeypatch.setattr(Client, "ask", lambda *_: ({}, {"state": np.zeros((3, 2))}))

    def connect_and_note():
        started.append(connect()())
        return started[-1]

    (found,) = record.record(connect_and_note, NAMES[:1], demos=1, workers=1)
    assert found.demos == []
    assert "demonstrate returned ['state'], expected an action" in found.problem
    assert [client._process.poll() for client in started] == [-9, -9]
