"""Checkpoints that are damaged, cannot be written, or were written by others."""

import errno
import json
import os
import pathlib
import resource
import signal
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from absl import logging

from milx.core import checkpoint
from milx.core.checkpoint import UNVALIDATED, Checkpoints

LIKE = {"params": {"a": jnp.zeros((3, 4)), "b": jnp.zeros(5)}, "trainer": (jnp.zeros((), jnp.int32), [jnp.zeros(2)])}


def items(step):
    return jax.tree.map(lambda x: (x + step).astype(x.dtype), LIKE)


def written(folder, scores):
    """Writes checkpoints of these scores, at steps 10, 20, ..."""
    checkpoints = Checkpoints(folder)
    for i, score in enumerate(scores):
        assert checkpoints.save(10 * (i + 1), items(10 * (i + 1)), score, {"number": i})
    checkpoints.close()
    return folder


def restored(checkpoints, step):
    found, extra = checkpoints.restore(step, LIKE)
    jax.tree.map(np.testing.assert_array_equal, found, items(step))
    return extra


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return written(tmp_path_factory.mktemp("checkpoints") / "checkpoints", [0.5, 0.4])


def files(folder):
    return sorted(path.relative_to(folder) for path in (folder / "20").rglob("*") if path.is_file())


def copy(folder, target):
    for path in folder.rglob("*"):
        if path.is_file():
            (target / path.relative_to(folder)).parent.mkdir(parents=True, exist_ok=True)
            (target / path.relative_to(folder)).write_bytes(path.read_bytes())
    return target


DAMAGES = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: len(path.read_bytes()) // 2]),
    "one bit": lambda path: path.write_bytes(bytes([path.read_bytes()[0] ^ 1]) + path.read_bytes()[1:]),
    "missing": lambda path: path.unlink(),
}


@pytest.mark.slow
@pytest.mark.parametrize("damage", DAMAGES)
def test_every_file_of_the_newest_checkpoint_is_guarded(folder, tmp_path, damage):
    """Damages each file in turn: the damage is reported, the checkpoint before it is used, and nothing is lost."""
    assert len(files(folder)) > 8
    for i, name in enumerate(files(folder)):
        mine, reports = copy(folder, tmp_path / str(i) / "checkpoints"), []
        path = mine / name
        if damage != "missing" and not path.read_bytes():
            continue
        DAMAGES[damage](path)
        looked = Checkpoints(mine, read_only=True, report=reports.append)
        if not reports:  # without its checksums, and else unharmed, it is as an earlier version wrote it
            assert (damage, name.name) == ("missing", "checksums.json")
            assert restored(looked, looked.latest) == {"number": 1}
            continue
        assert len(reports) == 1
        assert "20 is damaged and not used" in reports[0]
        assert (looked.latest, looked.best) == (10, 10)
        assert restored(looked, 10) == {"number": 0}
        assert (mine / "20").is_dir(), "looking changes nothing"

        checkpoints = Checkpoints(mine, report=reports.append)
        assert checkpoints.latest == 10
        assert (tmp_path / str(i) / "damaged" / "20").is_dir()
        assert checkpoints.save(20, items(20), 0.9, {"number": 2})
        assert restored(checkpoints, 20) == {"number": 2}
        checkpoints.close()


def test_there_is_no_silent_start_from_nothing(folder, tmp_path):
    mine = copy(folder, tmp_path / "checkpoints")
    for step in ("10", "20"):
        (mine / step / "_CHECKPOINT_METADATA").unlink()
    for read_only in (True, False):
        with pytest.raises(ValueError, match=r"checkpoints: all in .* are damaged, expected at least one that is not"):
            Checkpoints(mine, read_only=read_only, report=lambda _: None)
    assert (mine / "20").is_dir()


def test_a_full_disk_keeps_the_last_good_checkpoint_and_says_so(folder, tmp_path):
    """Limits the size of files in place of a full disk: writing fails in the same place, with another number."""
    mine, reports = copy(folder, tmp_path / "checkpoints"), []
    checkpoints = Checkpoints(mine, report=reports.append)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8, limits[1]))
    try:
        assert not checkpoints.save(30, items(30), 0.9, {"number": 2})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    (report,) = reports
    assert report.startswith("checkpoint of step 30 could not be written, the last good one is of step 20: ")
    assert restored(checkpoints, 20) == {"number": 1}
    assert checkpoints.save(30, items(30), 0.9, {"number": 3}), "there is room again"
    assert restored(checkpoints, 30) == {"number": 3}
    checkpoints.close()
    assert Checkpoints(mine, read_only=True).latest == 30


def full(*args, **kwargs):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_an_error_of_the_disk_is_reported_with_its_reason(folder, tmp_path, monkeypatch):
    reports = []
    checkpoints = Checkpoints(copy(folder, tmp_path / "checkpoints"), report=reports.append)
    monkeypatch.setattr(checkpoints._manager, "save", full)
    assert not checkpoints.save(30, items(30), 0.9, {})
    assert "No space left on device" in reports[0]


def test_what_orbax_logs_after_a_save_that_failed_is_not_seen(folder, tmp_path, monkeypatch, caplog):
    """Logs as a thread of Orbax does that goes on; a save that succeeds leaves logging as it was."""
    before = logging.get_verbosity()
    try:
        checkpoints = Checkpoints(copy(folder, tmp_path / "checkpoints"), report=lambda text: None)
        logging.set_verbosity(logging.ERROR)
        assert checkpoints.save(30, items(30), 0.9, {})
        logging.error("heard")
        monkeypatch.setattr(checkpoints._manager, "save", full)
        assert not checkpoints.save(40, items(40), 0.9, {})
        logging.error("not heard")
    finally:
        logging.set_verbosity(before)
    assert "heard" in caplog.messages
    assert "not heard" not in caplog.messages


def test_checkpoints_without_checksums_load(folder, tmp_path):
    """Loads checkpoints of earlier versions."""
    mine, reports = copy(folder, tmp_path / "checkpoints"), []
    for step in ("10", "20"):
        (mine / step / "checksums.json").unlink()
    checkpoints = Checkpoints(mine, read_only=True, report=reports.append)
    assert restored(checkpoints, checkpoints.latest) == {"number": 1}
    assert not reports


@pytest.mark.parametrize("error", [errno.EIO, errno.EMFILE, errno.EACCES], ids=errno.errorcode.get)
def test_what_cannot_be_read_now_is_no_damage(folder, tmp_path, monkeypatch, error):
    """Fails to read the newest checkpoint: an error, and nothing is moved or passed over."""
    mine, sha256 = copy(folder, tmp_path / "checkpoints"), checkpoint.files.sha256

    def fail(path):
        if "20" in path.parts:
            try:
                raise OSError(error, os.strerror(error))
            except OSError as cause:
                raise checkpoint.FileError(f"{path}: cannot be read: {cause.strerror}") from cause
        return sha256(path)

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint.files, "sha256", fail)
        for read_only in (True, False):
            with pytest.raises(ValueError, match=rf"20/.*: cannot be read: {os.strerror(error)}"):
                Checkpoints(mine, read_only=read_only, report=print)
    assert Checkpoints(mine, read_only=True, report=print).latest == 20


def test_a_link_in_a_checkpoint_is_damage(folder, tmp_path):
    """Puts a link in the place of a file; the checksums fit."""
    mine, reports = copy(folder, tmp_path / "checkpoints"), []
    path = mine / files(folder)[-1]
    path.rename(tmp_path / "aside")
    path.symlink_to(tmp_path / "aside")
    assert Checkpoints(mine, read_only=True, report=reports.append).latest == 10
    assert f"{path.name}: is a link, expected a file or a folder" in reports[0]


def test_a_truncated_one_without_checksums_is_passed_over(folder, tmp_path):
    mine, reports = copy(folder, tmp_path / "checkpoints"), []
    (mine / "20" / "checksums.json").unlink()
    for name in files(folder):
        if name.parts[1] == "params" and "d" in name.parts:
            DAMAGES["truncated"](mine / name)
    checkpoints = Checkpoints(mine, read_only=True, report=reports.append)
    assert restored(checkpoints, checkpoints.latest) == {"number": 0}
    assert "20 is damaged and not used: params cannot be read" in reports[0]
    view = checkpoints._view.name
    checkpoints.close()
    assert not pathlib.Path(view).exists()


def test_other_items_are_refused_with_a_reason(folder):
    checkpoints = Checkpoints(folder, read_only=True)
    a, b = jnp.zeros((3, 4)), jnp.zeros(5)
    for like in ({"params": {"a": a}}, *({"params": {"a": x, "b": b}} for x in (jnp.zeros((9, 9)), jnp.zeros((0, 4))))):
        expected = "20: cannot be restored, expected what this version of milx writes; it is of an unknown version"
        with pytest.raises(ValueError, match=expected):
            checkpoints.restore(20, like)


def test_a_refusal_names_the_version_that_wrote_it(tmp_path):
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    checkpoints.save(10, items(10), 0.5, {"versions": {"milx": "9.8.7", "jax": "0.1"}})
    with pytest.raises(ValueError, match=r"it is of milx 9\.8\.7 and jax 0\.1 "):
        checkpoints.restore(10, {"params": {"other": jnp.zeros(3)}})
    checkpoints.close()


def test_the_best_is_kept_and_one_that_nobody_validated_is_the_best_only_if_alone(tmp_path):
    folder = written(tmp_path / "a", [0.3, 0.8, 0.5, UNVALIDATED, UNVALIDATED])
    checkpoints = Checkpoints(folder, read_only=True)
    assert (checkpoints.best, checkpoints.latest) == (20, 50)
    assert sorted(int(path.name) for path in folder.iterdir() if path.name.isdigit()) == [20, 40, 50]
    alone = Checkpoints(written(tmp_path / "b", [UNVALIDATED]), read_only=True)
    assert (alone.best, alone.latest) == (10, 10)


def test_checksums_name_every_file(folder):
    names = json.loads((folder / "20" / "checksums.json").read_text())
    assert sorted(names) == [str(name.relative_to("20")) for name in files(folder) if name.name != "checksums.json"]


def test_a_checkpoint_that_is_written_again_is_never_lost(tmp_path, monkeypatch):
    """Kills the writer before the new checkpoint is there, or leaves no room for it: the old one is there."""
    folder, reports = written(tmp_path / "checkpoints", [UNVALIDATED]), []
    checkpoints = Checkpoints(folder, report=reports.append)

    def killed(*args, **kwargs):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(checkpoints, "save", killed)
        with pytest.raises(KeyboardInterrupt):
            checkpoints.replace(10, items(10), 0.5, {"number": 1})
    assert not (folder / "10").exists()
    checkpoints = Checkpoints(folder, report=reports.append)
    assert restored(checkpoints, checkpoints.latest) == {"number": 0}

    with monkeypatch.context() as patch:
        patch.setattr(checkpoints._manager, "save", full)
        assert not checkpoints.replace(10, items(10), 0.5, {"number": 1})
    assert restored(checkpoints, checkpoints.latest) == {"number": 0}
    assert checkpoints.replace(10, items(10), 0.5, {"number": 2})
    assert restored(checkpoints, checkpoints.latest) == {"number": 2}
    assert checkpoints.score(10) == 0.5
    assert not (tmp_path / "replaced").exists()

    def unreadable(path):
        raise AssertionError(path)

    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "_damage", unreadable)
        assert checkpoints.replace(10, items(10), 0.7, {"number": 3}), "what has just been written is not read again"
    assert not (tmp_path / "replaced").exists()
    assert restored(checkpoints, checkpoints.latest) == {"number": 3}
    checkpoints.close()


def test_without_checksums_every_file_counts(folder, tmp_path):
    for i, name in enumerate(("metrics/metrics", "extra/metadata")):
        mine, reports = copy(folder, tmp_path / str(i) / "checkpoints"), []
        (mine / "20" / "checksums.json").unlink()
        DAMAGES["truncated"](mine / "20" / name)
        assert Checkpoints(mine, read_only=True, report=reports.append).latest == 10
        assert name in reports[0]
    mine = copy(folder, tmp_path / "none" / "checkpoints")
    for text in ("null", "[1]", "{"):
        (mine / "20" / "checksums.json").write_text(text)
        reports = []
        assert Checkpoints(mine, read_only=True, report=reports.append).latest == 10
        assert "checksums.json holds no checksums" in reports[0] or "checksums.json: expected JSON" in reports[0]


def test_arrays_without_entries_come_back(tmp_path):
    checkpoints = Checkpoints(tmp_path / "checkpoints")
    tree = {"params": {"empty": jnp.zeros((0, 3), jnp.int32), "full": jnp.arange(4.0)}}
    assert checkpoints.save(10, tree, 0.5, {})
    found, _ = checkpoints.restore(10, tree)
    jax.tree.map(np.testing.assert_array_equal, found, tree)
    assert found["params"]["empty"].shape == (0, 3)
    checkpoints.close()


def rewritten(folder, name, values):
    """Replaces a JSON file of the newest checkpoint, with checksums that fit."""
    (folder / "20" / name).write_text(json.dumps(values))
    checkpoint._write_checksums(folder / "20")


@pytest.mark.parametrize(
    "score",
    ["high", None, [1], {"a": 1}, 1e999, True * 10**400],
    ids=lambda score: f"{score:.9}" if isinstance(score, str) else type(score).__name__,
)
def test_a_score_that_is_no_number_is_damage(folder, tmp_path, score):
    mine, reports = copy(folder, tmp_path / "checkpoints"), []
    rewritten(mine, "metrics/metrics", {"success": score})
    assert Checkpoints(mine, read_only=True, report=reports.append).latest == 10
    assert "20 is damaged and not used: its score is" in reports[0]
    (mine / "20" / "checksums.json").unlink()  # as in a checkpoint of an earlier version
    assert Checkpoints(mine, read_only=True, report=reports.append).latest == 10
    assert reports[1] == reports[0]


@pytest.mark.parametrize("extra", [3, [], {"format": 2}, {"format": "x"}])
def test_extra_values_of_another_format_are_refused(folder, tmp_path, extra):
    mine = copy(folder, tmp_path / "checkpoints")
    rewritten(mine, "extra/metadata", extra)
    expected = r"20: (got format .*, expected 1: it may have been made by a later milx|extra: got|cannot be restored)"
    with pytest.raises(ValueError, match=expected):
        Checkpoints(mine, read_only=True, report=print).restore(20, LIKE)


def test_a_file_that_is_far_too_large_is_damage_and_is_not_read(folder, tmp_path):
    """Appends a hole of 200 GiB to a file of the checkpoint."""
    mine, reports = copy(folder, tmp_path / "checkpoints"), []
    path = next(path for path in (mine / "20" / "params").rglob("*") if path.is_file())
    with path.open("ab") as file:
        file.truncate(200 << 30)
    began = time.monotonic()
    assert Checkpoints(mine, read_only=True, report=reports.append).latest == 10
    assert f"got {200 << 30} bytes, expected at most" in reports[0]
    assert time.monotonic() - began < 30
