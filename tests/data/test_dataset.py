"""Data sets on disk: what is written is read back, by milx and by zarr alone, and nothing is written over."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import zarr

from milx.data import check
from milx.data.dataset import DataSet, Writer, spread
from milx.types import Demo

RNG = np.random.default_rng(0)
LENGTHS = {"lift": [5, 70], "push": [40], "turn": [3, 4, 9]}
SPLIT = {"lift": "train", "push": "validation", "turn": "test"}


def random_demo(length, state=4, image=(24, 32), action=2):
    return Demo(
        image=RNG.integers(0, 256, (length, *image, 3), np.uint8) if image else None,
        state=RNG.normal(size=(length, state)).astype(np.float32) if state else None,
        action=RNG.normal(size=(length, action)).astype(np.float32) if action else None,
    )


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Writes a data set of three tasks; the second demonstration of the last one shows no actions."""
    folder = tmp_path_factory.mktemp("data") / "set"
    demos = {name: [random_demo(length) for length in lengths] for name, lengths in LENGTHS.items()}
    demos["turn"][1] = dataclasses.replace(demos["turn"][1], action=None)
    with Writer(folder, (24, 32), 4, 2, "a test") as writer:
        for name, own in demos.items():
            writer.add(name, SPLIT[name], LENGTHS[name], iter(own))
    return folder, demos


def test_demonstrations_come_back_bit_for_bit(written):
    folder, demos = written
    data = DataSet(folder)
    assert [(task.name, task.split, list(task.lengths)) for task in data.header.tasks] == [
        (name, SPLIT[name], lengths) for name, lengths in LENGTHS.items()
    ]
    for i, name in enumerate(demos):
        for j, demo in enumerate(demos[name]):
            read = data.read(i, j)
            for field in ("image", "state", "action"):
                np.testing.assert_equal(getattr(read, field), getattr(demo, field))
            few = data.read(i, j, np.array([2, 0, 2]), fields=("state",))
            np.testing.assert_array_equal(few.state, demo.state[[2, 0, 2]])
            assert few.image is None
    assert data.header.tasks[2].has_action == (True, False, True)


def test_a_chunk_that_has_changed_or_is_missing_is_noticed(written, tmp_path):
    folder, demos = written
    copy = shutil.copytree(folder, tmp_path / "set")
    chunks = sorted(path for path in copy.glob("0*/*/c/**/*") if path.is_file())
    assert len(chunks) == 9
    for number, path in enumerate(chunks):
        task, field = int(path.relative_to(copy).parts[0]), path.relative_to(copy).parts[1]
        whole = path.read_bytes()
        for at in range(0, len(whole), max(len(whole) // 10, 1)):
            path.write_bytes(whole[:at] + bytes([whole[at] ^ (1 << number % 8)]) + whole[at + 1 :])
            with pytest.raises(ValueError, match="a chunk is damaged, expected what was written"):
                DataSet(copy).read(task, 0, fields=(field,))
        path.unlink()
        with pytest.raises(ValueError, match="a chunk is damaged, expected what was written"):
            DataSet(copy).read(task, 0, fields=(field,))
        path.write_bytes(whole)
    np.testing.assert_array_equal(DataSet(copy).read(0, 0).image, demos["lift"][0].image)


def test_what_nobody_could_learn_from_is_refused(tmp_path):
    with pytest.raises(ValueError, match="action_size: got 0, expected at least 1: there is nothing to imitate"):
        Writer(tmp_path / "set", (24, 32), 4, 0)
    empty = pytest.raises(ValueError, match="demonstration 1 of 'lift': got no time steps, expected at least one")
    with empty, Writer(tmp_path / "set", (24, 32), 4, 2) as writer:
        writer.add("lift", "train", [5, 0], [random_demo(5), random_demo(0)])
    assert not (tmp_path / "set").exists()


def test_nothing_outside_the_folder_is_read(written, tmp_path):
    folder, _ = written
    copy = shutil.copytree(folder, tmp_path / "set")
    shutil.rmtree(copy / "00000")
    (copy / "00000").symlink_to(folder / "00000")
    with pytest.raises(ValueError, match="00000: is a link, expected a folder"):
        DataSet(copy).read(0, 0)


@pytest.mark.parametrize(
    "name", ["zarr.json", "00000/state", "00000/state/c", "00000/state/zarr.json", "00000/state/c/0/0"]
)
def test_links_inside_the_folder_are_not_followed(written, tmp_path, name):
    folder, _ = written
    copy = shutil.copytree(folder, tmp_path / "set")
    aside = (copy / name).rename(tmp_path / "aside")
    (copy / name).symlink_to(aside)
    with pytest.raises(ValueError, match=r"link.*, expected .*: links are not followed"):
        DataSet(copy).read(0, 0)


def test_what_is_too_large_is_refused_before_there_is_memory_for_it(written, tmp_path):
    """Refuses a header that promises much and chunks that unpack to much; neither needs a large file."""
    folder, _ = written
    copy = shutil.copytree(folder, tmp_path / "set")
    header, array = copy / "zarr.json", copy / "00000" / "state" / "zarr.json"
    values, metadata = json.loads(header.read_text()), json.loads(array.read_text())
    values["attributes"]["milx"]["tasks"][0]["lengths"] = [10**8, 10**12]
    metadata["shape"] = [10**8 + 10**12, 4]
    header.write_text(json.dumps(values))
    array.write_text(json.dumps(metadata))
    for refused in (lambda: DataSet(copy).fingerprint(), lambda: check.vectors(DataSet(copy))):
        with pytest.raises(ValueError, match=r"GiB, expected at most 8"):
            refused()
    metadata["chunk_grid"]["configuration"]["chunk_shape"] = [10**8, 4]
    array.write_text(json.dumps(metadata))
    with pytest.raises(ValueError, match=r"got chunks of \[100000000, 4\], expected at most 256 MiB"):
        DataSet(copy).read(0, 0, np.zeros(1, int), fields=("state",))


def test_zarr_alone_reads_it(written):
    folder, demos = written
    group = zarr.open_group(folder, mode="r")
    tasks = group.attrs["milx"]["tasks"]
    for i, (task, name) in enumerate(zip(tasks, demos, strict=True)):
        assert task["name"] == name
        for field in ("image", "state"):
            whole = np.concatenate([getattr(demo, field) for demo in demos[name]])
            np.testing.assert_array_equal(group[f"{i:05d}/{field}"][:], whole)
    assert np.isnan(group["00002/action"][3:7]).all(), "the demonstration without actions"


@pytest.mark.parametrize("instructions", [["one"], "do", ["do", None]])
def test_instructions_that_nobody_could_read_are_refused_before_anything_is_written(tmp_path, instructions):
    demo = Demo(None, np.zeros((3, 2)), np.zeros((3, 2)))
    with pytest.raises(ValueError, match="instructions of 'a': got"), Writer(tmp_path / "set", None, 2, 2) as writer:
        writer.add("a", "train", [3, 3], [demo, demo], instructions=instructions)
    assert not (tmp_path / "set").exists()


def test_vectors_without_images_and_images_without_vectors(tmp_path):
    for name, sizes in (("vectors", (None, 3, 2)), ("images", ((8, 9), 0, 2))):
        image, state, action = sizes
        demo = random_demo(6, state, image, action)
        with Writer(tmp_path / name, image, state, action) as writer:
            writer.add("task", "train", [6], [demo])
        read = DataSet(tmp_path / name).read(0, 0)
        for field in ("image", "state", "action"):
            np.testing.assert_equal(getattr(read, field), getattr(demo, field))


def test_an_existing_folder_is_left_alone(written):
    folder, _ = written
    before = (folder / "zarr.json").read_text()
    with pytest.raises(ValueError, match=r"out: .*set exists, expected a folder that does not"):
        Writer(folder, (24, 32), 4, 2)
    assert (folder / "zarr.json").read_text() == before


def test_what_goes_wrong_half_way_leaves_nothing_and_can_be_begun_again(tmp_path):
    folder = tmp_path / "set"
    demos = [random_demo(3, image=None), random_demo(5, state=3, image=None)]
    expected = r"demonstration 1 of 'a': state: got shape \[5, 3\], expected \[5, 4\]"
    with pytest.raises(ValueError, match=expected), Writer(folder, None, 4, 2) as writer:
        writer.add("a", "train", [3, 5], demos)
    assert not list(tmp_path.iterdir())
    (tmp_path / ".set.0123456789abcdef.partial").mkdir()  # as a process that was killed leaves it
    (tmp_path / ".set.0123456789abcdef.partial" / "rest").write_text("")
    with Writer(folder, None, 4, 2) as writer:
        writer.add("a", "train", [3], [random_demo(3, image=None)])
    assert [path.name for path in tmp_path.iterdir()] == ["set"]
    assert not (folder / "rest").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h: h.update(version=99), "version: got 99, expected 1"),
        (lambda h: h.pop("tasks"), "tasks"),
        (lambda h: h.update(image_shape=[24, 10**9]), "image: got the shape"),
        (lambda h: h["tasks"][0].update(split="dev"), r"tasks\[0\].split: got 'dev', expected one of train"),
        (lambda h: h["tasks"][1].update(lengths=[-3]), r"tasks\[1\].lengths: got \[-3\], expected positive"),
        (lambda h: h["tasks"][1].update(has_action=[]), r"tasks\[1\].has_action: got 0, expected 1"),
    ],
)
def test_damaged_headers_are_refused(written, tmp_path, change, message):
    values = json.loads((written[0] / "zarr.json").read_text())
    change(values["attributes"]["milx"])
    (tmp_path / "zarr.json").write_text(json.dumps(values))
    with pytest.raises(ValueError, match=message):
        DataSet(tmp_path)


def test_arrays_that_do_not_fit_the_header_are_refused(written, tmp_path):
    folder, _ = written
    values = json.loads((folder / "zarr.json").read_text())
    values["attributes"]["milx"]["tasks"][0]["lengths"] = [5, 10**8]
    (tmp_path / "zarr.json").write_text(json.dumps(values))
    shutil.copytree(folder / "00000", tmp_path / "00000")
    with pytest.raises(ValueError, match=r"state: got float32 \[75, 4\], expected float32 \[100000005, 4\]"):
        DataSet(tmp_path).read(0, 0, fields=("state",))
    with pytest.raises(ValueError, match=r"00001: cannot be read: No such file"):
        DataSet(tmp_path).read(1, 0, fields=("state",))
    with pytest.raises(ValueError, match=r"has no zarr\.json, expected a folder written by milx\.data"):
        DataSet(tmp_path / "none")


@pytest.mark.parametrize(("length", "horizon"), [(100, 50), (7, 20), (1, 4), (30, 1), (5, 5)])
def test_resampling_spreads_steps_evenly_over_the_demonstration(length, horizon):
    steps = spread(length, horizon)
    assert steps[0] == 0
    assert steps[-1] == (length - 1 if horizon > 1 else 0)
    even = np.arange(horizon) * (length - 1) / max(horizon - 1, 1)
    assert np.abs(steps - even).max() <= 0.5
