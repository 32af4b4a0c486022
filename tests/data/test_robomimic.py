"""Files in robomimic's layout, and damaged or hostile ones."""

import pathlib
import shutil
import sys

import h5py
import numpy as np
import pytest

from milx.data import episodes
from milx.data.dataset import DataSet
from milx.data.robomimic import Robomimic

FIXTURES = pathlib.Path(__file__).parents[1] / "fixtures"
sys.path.insert(0, str(FIXTURES))
import make_robomimic  # noqa: E402

STATE = "robot0_eef_pos,robot0_gripper_qpos"


def open_set(path=FIXTURES / "robomimic", camera=None, state=STATE, action="actions", height=128):
    return Robomimic(path, camera, state, action, height)


@pytest.fixture
def copy(tmp_path):
    return pathlib.Path(shutil.copy(FIXTURES / "robomimic" / "lift.hdf5", tmp_path / "lift.hdf5"))


def test_an_import_is_a_data_set(tmp_path):
    """Makes a task of each file, with demonstrations in the order of their numbers and states side by side."""
    source = open_set(height=10)
    episodes.write(tmp_path / "out", source.episodes("file"), source.contents, (0.0, 0.5), "there")
    data = DataSet(tmp_path / "out")
    assert [task.name for task in data.header.tasks] == ["lift", "stack"]
    assert sorted(task.split for task in data.header.tasks) == ["test", "train"]
    for i, task in enumerate(data.header.tasks):
        lengths = make_robomimic.LENGTHS[task.name]
        for j, demo in enumerate(sorted(lengths)):
            steps = [make_robomimic.step(task.name, demo, t) for t in range(lengths[demo])]
            image, eef, grip, action = map(np.stack, zip(*steps, strict=True))
            read = data.read(i, j)
            np.testing.assert_allclose(read.state, np.concatenate([eef, grip], axis=1), rtol=1e-6)
            np.testing.assert_allclose(read.action, action, rtol=1e-6)
            halved = image.reshape(len(image), 10, 2, 15, 2, 3).mean(axis=(2, 4))
            assert np.abs(read.image - halved).max() <= 1


def test_an_episode_that_does_not_fit_is_named_or_left_out(copy, tmp_path):
    """Shortens the actions of one demonstration, and widens the state of another."""
    replace(copy, "data/demo_1/actions", np.zeros((4, 7)))
    replace(copy, "data/demo_2/obs/robot0_eef_pos", np.zeros((6, 5)))
    source = open_set(copy)
    found = source.episodes("file")
    assert [episode.name for episode in episodes.readable(found, source.contents)] == ["lift/demo_0", "lift/demo_10"]
    with pytest.raises(ValueError, match="data/demo_1: got lengths"):
        episodes.write(tmp_path / "out", found, source.contents, (0.0, 0.0), "there")
    del found[1]
    with pytest.raises(ValueError, match=r"state of episode lift/demo_2: got shape \[6, \d+\], expected \[6, "):
        episodes.write(tmp_path / "out", found, source.contents, (0.0, 0.0), "there")


def test_a_single_file_and_a_mapping(tmp_path):
    path = tmp_path / "tasks.json"
    path.write_text('{"lift/demo_0": "a", "lift/demo_1": "b", "lift/demo_2": "a", "lift/demo_10": "b"}')
    found = open_set(FIXTURES / "robomimic" / "lift.hdf5").episodes(str(path))
    assert [(e.task, e.length) for e in found] == [("a", 7), ("b", 9), ("a", 6), ("b", 8)]


def test_several_cameras_and_the_control_frequency_are_kept(copy, tmp_path):
    rng, wrist = np.random.default_rng(0), {}
    with h5py.File(copy, "a") as file:
        file["data"].attrs["env_args"] = '{"env_name": "Lift", "env_kwargs": {"control_freq": 20}}'
        for name, demo in file["data"].items():
            wrist[name] = rng.integers(0, 256, (len(demo["actions"]), 6, 8, 3), np.uint8)
            demo["obs/eye_in_hand_image"] = wrist[name]
    source, alone = open_set(copy, camera="agentview_image,eye_in_hand_image"), open_set(copy, camera="agentview_image")
    assert source.contents.fps == 20
    for episode, other in zip(source.episodes("file"), alone.episodes("file"), strict=True):
        image = episode.read().image
        np.testing.assert_array_equal(image["eye_in_hand"], wrist[episode.name.split("/")[1]])
        np.testing.assert_array_equal(image["agentview"], other.read().image)


def say_rate(path, rate):
    with h5py.File(path, "a") as file:
        file["data"].attrs["env_args"] = f'{{"env_kwargs": {{"control_freq": {rate}}}}}'


@pytest.mark.parametrize("rate", ["", "3]", '"20"', "true", "0", "1e6", "1" + 400 * "0", "[20]"])
def test_files_that_do_not_say_how_fast_they_are_have_no_rate(copy, rate):
    say_rate(copy, rate)
    assert open_set(copy).contents.fps is None


def test_files_of_different_rates_have_none_in_common(copy):
    say_rate(copy, 20)
    other = shutil.copy(copy, copy.parent / "stack.hdf5")
    assert open_set(copy.parent).contents.fps == 20
    say_rate(other, 10)
    assert open_set(copy.parent).contents.fps is None


def replace(path, name, value):
    with h5py.File(path, "a") as file:
        del file[name]
        if value is not None:
            file[name] = value


def virtual(path):
    layout = h5py.VirtualLayout((7, 4), float)
    layout[:] = h5py.VirtualSource("/etc/passwd", "actions", (7, 4))
    with h5py.File(path, "a") as file:
        del file["data/demo_0/actions"]
        file.create_virtual_dataset("data/demo_0/actions", layout)


def external(path):
    with h5py.File(path, "a") as file:
        del file["data/demo_0/actions"]
        file.create_dataset("data/demo_0/actions", (7, 4), float, external=[("/etc/passwd", 0, 224)])


def enormous(path):
    with h5py.File(path, "a") as file:
        del file["data/demo_0/actions"]
        file.create_dataset("data/demo_0/actions", (10**9, 4), float, chunks=(1000, 4))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.write_bytes(b"HDF"), "expected an HDF5 file that can be read"),
        (lambda path: replace(path, "data/demo_0/actions", None), "data/demo_0/actions: missing, expected it beside"),
        (
            lambda path: replace(path, "data/demo_0/actions", np.zeros((7, 2, 2))),
            r"got float64 \[7, 2, 2\], expected numbers",
        ),
        (lambda path: replace(path, "data/demo_0/actions", np.zeros((6, 4))), "got lengths"),
        (lambda path: replace(path, "data/demo_0/obs/agentview_image", np.zeros((7, 20, 30, 3))), "expected uint8"),
        (
            lambda path: replace(path, "data", h5py.ExternalLink("/etc/passwd", "/")),
            "data: data is a link out of its group",
        ),
        (
            lambda path: replace(path, "data/demo_0/actions", h5py.ExternalLink("../x.hdf5", "/a")),
            "actions is a link out of its group",
        ),
        (lambda path: replace(path, "data/demo_0/obs", h5py.SoftLink("/hidden")), "obs is a link out of its group"),
        (virtual, "is stored outside the file"),
        (external, "is stored outside the file"),
        (enormous, r"got shape \[1000000000, 4\], 29.8 GiB, expected at most 8"),
    ],
)
def test_damaged_and_hostile_files_are_refused(copy, damage, message):
    damage(copy)
    with pytest.raises(ValueError, match=message):
        open_set(copy).episodes("file")[0].read()


def test_observations_that_do_not_exist_are_named(copy, tmp_path):
    with pytest.raises(
        ValueError, match="obs/wrist: missing, expected it beside agentview_image, robot0_eef_pos, robot0_gripper"
    ):
        open_set(copy, state="wrist")
    with pytest.raises(ValueError, match=r"expected a file in robomimic's layout, or a folder of \*.hdf5 files"):
        open_set(tmp_path / "none")
    with h5py.File(copy, "a") as file:
        file["data/demo_0/obs/wrist_image"] = np.zeros((7, 2, 2, 3), np.uint8)
    with pytest.raises(ValueError, match="camera: expected one or several of agentview_image,wrist_image"):
        open_set(copy)
