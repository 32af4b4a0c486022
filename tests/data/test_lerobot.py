"""LeRobot's data sets: one that the real writer wrote, and damaged or hostile copies of it."""

import dataclasses
import io
import json
import pathlib
import re
import shlex
import shutil
import subprocess
import sys

import numpy as np
import pyarrow
import pyarrow.parquet
import pytest
from PIL import Image

from milx.data import check, dataset, episodes, lerobot
from milx.data.dataset import DataSet
from milx.data.lerobot import LeRobot

FIXTURES = pathlib.Path(__file__).parents[1] / "fixtures"
sys.path.insert(0, str(FIXTURES))
import make_lerobot  # noqa: E402

ROOT = FIXTURES / "lerobot"
TOP, WRIST = "observation.images.top", "observation.images.wrist"


def open_set(root=ROOT, camera=TOP, state="observation.state", action="action", height=128):
    return LeRobot(root, camera, state, action, height)


@pytest.fixture
def copy(tmp_path):
    """Copies the fixture, so that a test may damage it."""
    return pathlib.Path(shutil.copytree(ROOT, tmp_path / "copy"))


def change_info(root, **changes):
    path = root / "meta" / "info.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def change_episodes(root, column, value):
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pyarrow.parquet.read_table(path)
    index = table.column_names.index(column)
    field = table.schema.field(index)
    pyarrow.parquet.write_table(table.set_column(index, field, pyarrow.array([value] * len(table), field.type)), path)


def expected(episode, camera):
    """Makes [T, ...] images, states and actions as the script made them."""
    steps = range(make_lerobot.EPISODES[episode][1])
    top, wrist, state, action = map(np.stack, zip(*(make_lerobot.frame(episode, t) for t in steps), strict=True))
    return (top if camera == TOP else wrist), state, action


@pytest.mark.parametrize("camera", [TOP, WRIST])
def test_every_episode_is_read_as_it_was_written(camera):
    """Pairs the video's frames with the steps of states and actions, in whichever file they lie."""
    found = open_set(camera=camera).episodes("task_index")
    assert [(e.task, e.length) for e in found] == [(make_lerobot.TASKS[t], n) for t, n in make_lerobot.EPISODES]
    for number, episode in enumerate(found):
        image, state, action = expected(number, camera)
        demo = episode.read()
        np.testing.assert_array_equal(demo.state, state)
        np.testing.assert_array_equal(demo.action, action)
        # Video is lossy, and worst where the halves meet; neighboring steps differ by 15.
        error = np.abs(demo.image.astype(int) - image)
        assert error[:, :, [5, -5]].max() < (7 if camera == TOP else 1)


def test_an_import_is_a_data_set(tmp_path):
    source = open_set(height=24)
    episodes.write(tmp_path / "out", source.episodes("task_index"), source.contents, (0.3, 0.4), "there")
    data = DataSet(tmp_path / "out")
    assert data.header.image_shape == (24, 32)
    assert [task.name for task in data.header.tasks] == sorted(make_lerobot.TASKS)
    assert (data.header.fps, data.header.action_names) == (make_lerobot.FPS, ("x", "y", "grip"))
    assert all(set(task.instructions) == {task.name} for task in data.header.tasks)
    assert sorted(task.split for task in data.header.tasks) == ["test", "train", "validation"]
    for i, task in enumerate(data.header.tasks):
        own = [n for n, (t, _) in enumerate(make_lerobot.EPISODES) if make_lerobot.TASKS[t] == task.name]
        for j, episode in enumerate(own):
            image, state, action = expected(episode, TOP)
            demo = data.read(i, j)
            np.testing.assert_array_equal(demo.state, state)
            np.testing.assert_array_equal(demo.action, action)
            halved = image.reshape(len(image), 24, 2, 32, 2, 3).mean(axis=(2, 4))
            assert np.abs(demo.image - halved)[:, :, [3, -3]].max() < 7
    problems = " ".join(check.problems(data))
    assert "state[3] (d) is constant" in problems
    assert "action[2] (grip) is constant" in problems
    assert "first image is of one color" in problems, "that of the first episode"


def test_several_cameras_and_parts_of_the_state_are_imported_together():
    """Compares with what is imported one by one; actions stand in for another part of the state."""
    both = open_set(camera=f"{TOP},{WRIST}", state="observation.state,action", height=24)
    assert both.contents.image_shape == {"top": (24, 32), "wrist": (16, 16)}
    assert both.contents.state_names == ("a", "b", "c", "d", "x", "y", "grip")
    top, wrist = open_set(camera=TOP, height=24), open_set(camera=WRIST)
    for together, *apart in zip(*(each.episodes("task_index") for each in (both, top, wrist)), strict=True):
        demo, *single = (each.read() for each in (together, *apart))
        np.testing.assert_array_equal(demo.image["top"], single[0].image)
        np.testing.assert_array_equal(demo.image["wrist"], single[1].image)
        np.testing.assert_array_equal(demo.state, np.concatenate([single[0].state, single[0].action], axis=1))


def test_files_or_a_mapping_make_tasks(tmp_path):
    by_file = [episode.task for episode in open_set().episodes("file")]
    assert by_file[:4] == ["data/chunk-000/file-000.parquet"] * 2 + ["data/chunk-000/file-001.parquet"] * 2
    path = tmp_path / "tasks.json"
    path.write_text(json.dumps({str(i): "even" if i % 2 == 0 else "odd" for i in range(9)}))
    assert [episode.task for episode in open_set().episodes(str(path))] == ["even", "odd"] * 4 + ["even"]
    path.write_text(json.dumps({"0": "even"}))
    with pytest.raises(ValueError, match="does not say where '1' belongs"):
        open_set().episodes(str(path))


def test_some_episodes_are_selected_and_bad_ones_left_out(copy, capsys):
    found = open_set(copy).episodes("task_index")
    names = lambda wanted: [episode.name for episode in episodes.selected(found, wanted)]  # noqa: E731
    assert names("") == [str(i) for i in range(9)]
    assert names("1-3,7") == ["1", "2", "3", "7"]
    with pytest.raises(ValueError, match="episodes: got '9', which fits none, expected names such as 0, 1"):
        names("9")
    broken = dataclasses.replace(found[1].read(), action=found[1].read().action.astype(float))
    found[1] = found[1]._replace(read=lambda: broken)
    contents = open_set(copy).contents
    named = contents._replace(action_names=tuple(f"motor {i}" for i in range(contents.action_size)))
    for value, got in ((1e300, "inf"), (-1e20, r"-1\.0\d+e\+20")):
        broken.action[7, 1] = value
        message = rf"action\[1\] \(motor 1\) of episode 1: got {got} at time step 7, expected .* at most 1e\+12"
        with pytest.raises(ValueError, match=message):
            episodes.write(copy / "out", found, named, (0.3, 0.3), "there")
        assert not (copy / "out").exists()
    broken.action[7, 1] = 1e300
    kept = episodes.readable(found, contents)
    assert [episode.name for episode in kept] == ["0", *map(str, range(2, 9))]
    assert "episode 1 is left out: action[1]" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("module", ["milx.data.lerobot", "milx.data.robomimic", "milx.worlds.record"])
def test_help_lists_the_flags_of_all_importers_and_recorders(module):
    said = subprocess.run([sys.executable, "-m", module, "--help"], capture_output=True, text=True, timeout=60).stdout
    own = {"milx.worlds.record": "demos python workers timeout"}
    flags = (
        own.get(module, "camera state action task classes episodes skip_bad") + " height validation test family splits"
    )
    for flag in flags.split():
        assert re.search(rf"^\s*--(\[no\])?{flag}:", said, re.MULTILINE), flag


def test_states_and_actions_may_lack():
    source = open_set(camera="", action="")
    assert source.contents == (None, 4, 0, make_lerobot.FPS, ("a", "b", "c", "d"), (), ())
    (demo,) = (episode.read() for episode in source.episodes("task_index")[:1])
    assert demo.image is None
    assert demo.action is None
    assert open_set(state="").contents.state_size == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"camera": None}, f"camera: expected one or several of {TOP},{WRIST}"),
        ({"camera": "front"}, "feature: got 'front', expected one of observation.state"),
        ({"camera": "action"}, r"feature 'action': got float32 \[3\], expected video or image with 3 axes"),
        ({"state": TOP}, "expected float32 or float64 or int64 with 1 axes"),
    ],
)
def test_features_that_do_not_fit_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        open_set(**arguments)


def test_a_value_that_is_stored_once_and_meant_often_is_refused(copy, monkeypatch):
    """Builds a file of some kB, by a dictionary, of what is 320 MB in memory."""
    monkeypatch.setattr(dataset, "MAX_BYTES", 1 << 26)
    monkeypatch.setattr(lerobot, "_BATCH_BYTES", 1 << 24)
    path = copy / "meta/episodes/chunk-000/file-000.parquet"
    rows = pyarrow.parquet.read_table(path).slice(0, 1).to_pylist() * 5000
    for row in rows:
        row["tasks"] = ["x" * (1 << 16)]
    pyarrow.parquet.write_table(pyarrow.Table.from_pylist(rows), path)
    assert path.stat().st_size < 1 << 18
    with pytest.raises(ValueError, match=r"file-000\.parquet: got shape .* GiB, expected at most"):
        open_set(copy).episodes("task_index")


def test_older_versions_name_the_converter(copy):
    """Reads the command as a shell would: the converter looks for ROOT/REPO_ID."""
    change_info(copy, codebase_version="v2.1")
    message = r"codebase_version: got v2\.1, expected v3\.0; LeRobot 0\.4 converts it: `"
    with pytest.raises(ValueError, match=message) as error:
        open_set(copy)
    words = shlex.split(str(error.value).split("`")[1])
    assert words[:3] == ["python", "-m", "lerobot.datasets.v30.convert_dataset_v21_to_v30"]
    given = dict(word.removeprefix("--").split("=") for word in words[3:])
    assert pathlib.Path(given["root"]) / given["repo-id"] == copy.resolve()
    assert given["push-to-hub"] == "false"
    for other in ("v2.0", "v4.0"):
        change_info(copy, codebase_version=other)
        with pytest.raises(ValueError, match=rf"codebase_version: got {other}, expected v3\.0$"):
            open_set(copy)


@pytest.mark.parametrize("path", ["../../secret.parquet", "/etc/passwd", "{chunk_index.__class__}.parquet", "linked"])
def test_nothing_outside_the_folder_is_read(copy, path):
    """Refuses "..", absolute paths and links, and does not take templates for Python."""
    shutil.copy(ROOT / "data/chunk-000/file-000.parquet", copy.parent / "secret.parquet")
    (copy / "linked").symlink_to(copy.parent / "secret.parquet")
    change_info(copy, data_path=path)
    with pytest.raises(ValueError, match=r"leads out of the folder|is missing"):
        open_set(copy).episodes("task_index")
    outside = "videos/../../../" + "x" * 3
    change_info(copy, data_path="data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet", video_path=outside)
    with pytest.raises(ValueError, match="leads out of the folder"):
        open_set(copy).episodes("task_index")[0].read()


def test_a_linked_episodes_folder_is_not_followed(copy):
    shutil.move(copy / "meta/episodes/chunk-000", copy.parent / "elsewhere")
    (copy / "meta/episodes/chunk-000").symlink_to(copy.parent / "elsewhere")
    with pytest.raises(ValueError, match="leads out of the folder"):
        open_set(copy).episodes("task_index")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda root: (root / "meta/info.json").write_text("{"), "expected LeRobot's metadata"),
        (lambda root: (root / "meta/info.json").unlink(), "has no meta/info.json, expected a LeRobot data set"),
        (lambda root: shutil.rmtree(root / "meta/episodes"), "meta/episodes is empty, expected episodes"),
        (lambda root: change_info(root, fps=0), "features or fps: expected what LeRobot writes"),
        (
            lambda root: (root / "data/chunk-000/file-000.parquet").write_bytes(b"PAR1"),
            "expected a parquet file that can be read",
        ),
        (
            lambda root: (root / f"videos/{TOP}/chunk-000/file-000.mp4").write_bytes(b"x" * 99),
            "expected a video that can be read",
        ),
        (lambda root: (root / f"videos/{TOP}/chunk-000/file-000.mp4").unlink(), "file-000.mp4 is missing"),
        (lambda root: change_episodes(root, f"videos/{TOP}/from_timestamp", 60.0), "expected a frame at 60.000 s"),
        (lambda root: change_episodes(root, "length", 10**6), "got 12 rows of episode 0, expected 1000000"),
        (
            lambda root: change_episodes(root, "length", 0),
            "episode 0: length: got 0, expected a whole number, at least 1",
        ),
        (lambda root: change_episodes(root, "tasks", []), r"episode 0: tasks: got \[\], expected at least one"),
    ],
)
def test_damaged_sets_are_refused(copy, damage, message):
    lerobot._read_table.cache_clear()
    damage(copy)
    with pytest.raises(ValueError, match=message):
        open_set(copy).episodes("task_index")[0].read()


def test_a_playlist_in_place_of_a_video_is_not_played(copy):
    """Replaces every video by a list for FFmpeg's concat demuxer, which would open the video outside the folder."""
    outside = shutil.copy(next(copy.glob("videos/**/*.mp4")), copy.parent / "outside.mp4")
    for path in copy.glob("videos/**/*.mp4"):
        path.write_text(f"ffconcat version 1.0\nfile {outside}\n")
    with pytest.raises(ValueError, match=r"mp4: expected a video that can be read"):
        open_set(copy).episodes("task_index")[0].read()


def test_a_path_is_no_protocol(copy, monkeypatch):
    """Opens a video of the data set by a path that FFmpeg would take for another file's if it were not absolute."""
    inside, outside = sorted(copy.glob(f"videos/{TOP}/**/*.mp4"))[0], copy.parent / "outside.mp4"
    outside.write_bytes(b"no video")
    monkeypatch.chdir(copy)
    path = pathlib.Path(f"file:{outside}")
    path.parent.mkdir(parents=True)
    shutil.copy(inside, path)
    frames = [next(lerobot.read_video(video, 0.0, 1, make_lerobot.FPS)) for video in (path, inside)]
    np.testing.assert_array_equal(*frames)
    with pytest.raises(ValueError, match="expected a video"):
        next(lerobot.read_video(outside, 0.0, 1, make_lerobot.FPS))


def test_images_are_png_or_jpeg(copy):
    """Shows PostScript and BMP, for which Pillow has readers, too; the first one starts Ghostscript."""
    postscript = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"
    bitmap = io.BytesIO()
    Image.new("RGB", (4, 4)).save(bitmap, "BMP")
    for content in (postscript, bitmap.getvalue()):
        with pytest.raises(ValueError, match="expected an image that can be read"):
            list(lerobot._images(copy, [{"bytes": content}]))
