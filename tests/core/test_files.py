"""Files that are whole or not there, whatever fails, and that are refused if they are links, too large or damaged."""

import errno
import json
import os
import pathlib
import resource
import signal
import subprocess
import sys

import numpy as np
import pytest

from milx.core import files
from milx.core.files import FileError

HOLD = """
import pathlib, sys, time
from milx.core import files
with files.{holder}(pathlib.Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def hold(holder, path):
    """Starts a process that waits inside a function of `files`."""
    command = [sys.executable, "-c", HOLD.format(holder=holder), str(path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    return process


def end(process):
    process.kill()
    process.wait()


WRITERS = {
    "bytes": lambda path, value: files.write_bytes(path, bytes([value]) * 5000),
    "json": lambda path, value: files.write_json(path, [value] * 500),
    "arrays": lambda path, value: files.write_arrays(path, {"a": np.full(5000, value)}),
}
READERS = {
    "bytes": lambda path: files.read_bytes(path)[-1],
    "json": lambda path: files.read_json(path)[-1],
    "arrays": lambda path: files.read_arrays(path)["a"][-1],
}


class Faults:
    """Makes the n-th operation fail of those that write: creating, opening, synchronizing, renaming."""

    NAMES = (("open", os), ("fsync", os), ("replace", pathlib.Path), ("touch", pathlib.Path), ("open", pathlib.Path))

    def __init__(self, patch, number, error):
        self.number, self.error, self.count = number, error, 0
        for name, owner in self.NAMES:
            patch.setattr(owner, name, self._failing(getattr(owner, name)))

    def _failing(self, function):
        def call(*args, **kwargs):
            self.count += 1
            if self.count == self.number:
                raise OSError(self.error, os.strerror(self.error))
            return function(*args, **kwargs)

        return call


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EIO, errno.EDQUOT], ids=errno.errorcode.get)
@pytest.mark.parametrize("kind", WRITERS)
def test_whichever_operation_fails_the_file_is_the_old_one_or_the_new_one(tmp_path, monkeypatch, kind, error):
    """Fails every operation in turn: an error that names the file, one of the two contents, and no leftovers."""
    path = tmp_path / "folder" / "file"
    WRITERS[kind](path, 1)
    for number in range(1, 100):
        WRITERS[kind](path, 1)
        with monkeypatch.context() as patch:
            faults = Faults(patch, number, error)
            try:
                WRITERS[kind](path, 2)
            except FileError as failure:
                assert str(failure) == f"{path}: cannot be written: {os.strerror(error)}"
                failed = True
            else:
                failed = False
        if faults.count < number:
            break
        assert READERS[kind](path) in ((1, 2) if failed else (2,))
        assert [found.name for found in path.parent.iterdir()] == ["file"]
    assert number > 5


@pytest.mark.parametrize("kind", WRITERS)
def test_a_short_write_leaves_the_old_file(tmp_path, kind):
    """Limits the size of files, as a full disk does after some bytes."""
    path = tmp_path / "file"
    WRITERS[kind](path, 1)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20, limits[1]))
    try:
        with pytest.raises(FileError, match="file: cannot be written: File too large"):
            WRITERS[kind](path, 2)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    assert READERS[kind](path) == 1
    assert [found.name for found in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(("holder", "name"), [("replacing", "file"), ("creating", "folder")])
def test_leftovers_of_killed_processes_are_removed_and_those_of_others_are_not(tmp_path, holder, name):
    process = hold(holder, tmp_path / name)
    (partial,) = tmp_path.iterdir()
    files.write_bytes(tmp_path / "other", b"")
    assert partial.exists(), "its process lives"
    end(process)
    (tmp_path / ".mine.partial").write_text("another program's")
    files.write_bytes(tmp_path / "other", b"")
    assert sorted(found.name for found in tmp_path.iterdir()) == [".mine.partial", "other"]


def test_two_processes_write_the_same_file(tmp_path):
    """Writes while another process writes the same file: both names differ, so both files are whole."""
    process = hold("replacing", tmp_path / "file")
    files.write_bytes(tmp_path / "file", b"mine")
    assert (tmp_path / "file").read_bytes() == b"mine"
    assert len(list(tmp_path.iterdir())) == 2
    end(process)


def test_a_lock_is_held_by_one_process_and_is_free_when_it_has_died(tmp_path):
    lock = tmp_path / "lock"
    first = hold("locked", lock)
    with (
        pytest.raises(FileError, match=rf"is in use by process {first.pid} on .*, expected no other"),
        files.locked(lock),
    ):
        pass
    end(first)
    with files.locked(lock):
        assert f"process {os.getpid()} " in lock.read_text()
        with pytest.raises(FileError, match=rf"in use by process {os.getpid()} "), files.locked(lock):
            pass
    with files.locked(lock):
        pass


def test_without_locks_files_are_written_and_leftovers_stay(tmp_path, monkeypatch):
    """Writes on a file system that has no locks, as some networks' have none; a run needs them."""

    def flock(*_):
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(files.fcntl, "flock", flock)
    (tmp_path / ".other.0123456789abcdef.partial").write_text("")
    files.write_json(tmp_path / "file", 1)
    assert files.read_json(tmp_path / "file") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == [".other.0123456789abcdef.partial", "file"]
    with pytest.raises(FileError, match=r"lock: cannot be locked, expected a file system with locks: No locks"):
        files.locked(tmp_path / "lock").__enter__()


def test_where_only_what_is_open_for_writing_is_locked_a_file_of_a_living_process_stays(tmp_path, monkeypatch):
    """Locks as NFS does, which refuses exclusive locks of what is open for reading, and so has none for folders."""
    flock = files.fcntl.flock

    def nfs(descriptor, operation):
        if files.fcntl.fcntl(descriptor, files.fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        flock(descriptor, operation)

    monkeypatch.setattr(files.fcntl, "flock", nfs)
    with files.replacing(tmp_path / "one") as partial:
        files.write_json(tmp_path / "other", 1)
        partial.write_text("whole")
    with files.creating(tmp_path / "folder") as partial:
        files.write_json(tmp_path / "other", 2)
        (partial / "file").write_text("whole")
    assert (tmp_path / "one").read_text() == (tmp_path / "folder" / "file").read_text() == "whole"
    (tmp_path / ".one.0123456789abcdef.partial").write_text("of a process that was killed")
    files.write_json(tmp_path / "other", 3)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["folder", "one", "other"]


def test_a_pipe_in_place_of_a_leftover_keeps_nobody_waiting(tmp_path):
    os.mkfifo(tmp_path / ".file.0123456789abcdef.partial")
    files.write_json(tmp_path / "file", 1)
    assert files.read_json(tmp_path / "file") == 1


def test_what_cannot_be_appended_leaves_the_lines_before_and_room_for_those_after(tmp_path):
    """Limits the size of the file in the middle of a line, as a full disk would, and lifts the limit again."""
    path = tmp_path / "lines"
    files.append(path, "first\n")
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10, limits[1]))
    try:
        with pytest.raises(FileError, match="lines: cannot be written: File too large"):
            files.append(path, "second\n")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    files.append(path, "third\n")
    assert path.read_text() == "first\nthird\n"


def test_what_is_moved_replaces_nothing_and_what_is_removed_is_not_what_links_name(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text(name)
    with pytest.raises(FileError, match="b: exists, expected nothing there"):
        files.move(tmp_path / "a", tmp_path / "b")
    files.move(tmp_path / "a", tmp_path / "c" / "a")
    assert (tmp_path / "c" / "a" / "file").read_text() == "a"
    (tmp_path / "link").symlink_to(tmp_path / "b")
    for name in ("link", "c", "nothing"):
        files.remove(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["b"]
    assert (tmp_path / "b" / "file").read_text() == "b"


def test_a_folder_appears_whole_or_not_at_all(tmp_path):
    with pytest.raises(ZeroDivisionError), files.creating(tmp_path / "set") as partial:
        (partial / "file").write_text("a")
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())
    with files.creating(tmp_path / "set") as partial:
        (partial / "file").write_text("a")
        assert not (tmp_path / "set").exists()
    assert (tmp_path / "set" / "file").read_text() == "a"
    with pytest.raises(FileError, match="exists, expected a folder that does not"), files.creating(tmp_path / "set"):
        pass


def test_links_are_not_followed(tmp_path):
    (tmp_path / "secret.json").write_text("[1]")
    root = tmp_path / "root"
    (root / "inner").mkdir(parents=True)
    (root / "file").write_text("a")
    (root / "link").symlink_to(root / "file")
    (root / "out").symlink_to(tmp_path)
    with pytest.raises(FileError, match="link: is a link, expected a file"):
        files.read_bytes(root / "link")
    for path in ("link", "out/secret.json", "../secret.json", "/etc/passwd", "x" * 5000, "nothing", "a\0b"):
        with pytest.raises(FileError, match="expected"):
            files.inside(root, path)
    assert files.inside(root, "file") == root / "file"
    with pytest.raises(FileError, match=r"(link|out): is a link, expected a file or a folder"):
        files.refuse_links(root)
    with pytest.raises(FileError, match=r"out: is a link, expected a folder"):
        files.refuse_links(root / "out")
    files.refuse_links(root / "inner")
    os.mkfifo(root / "inner" / "pipe")
    with pytest.raises(FileError, match=r"inner/pipe: is no file, expected a file or a folder"):
        files.refuse_links(root / "inner")


def test_what_is_too_large_is_refused_before_it_is_read(tmp_path, monkeypatch):
    """Reads a file that would be a terabyte, and an archive whose arrays would be."""
    huge = tmp_path / "huge"
    with huge.open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(FileError, match=f"huge: got {1 << 40} bytes, expected at most {files.MAX_BYTES}"):
        files.read_bytes(huge)
    with pytest.raises(FileError, match=f"huge: got {1 << 40} bytes"):
        files.sha256(huge)
    with pytest.raises(FileError, match=f"expected at most {files.MAX_JSON_BYTES}"):
        files.read_json(huge)
    files.write_arrays(tmp_path / "arrays", {"a": np.zeros(5000)})
    monkeypatch.setattr(files, "MAX_BYTES", 5000)
    assert (tmp_path / "arrays").stat().st_size < 5000
    with pytest.raises(FileError, match=r"arrays: got .* GiB of arrays, expected at most"):
        files.read_arrays(tmp_path / "arrays")


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 100_000, b"PK\x03\x04garbage", b"\x93NUMPY"])
def test_damaged_contents_are_one_kind_of_error(tmp_path, content):
    (tmp_path / "file").write_bytes(content)
    with pytest.raises(FileError, match=r"file: expected JSON: "):
        files.read_json(tmp_path / "file")
    with pytest.raises(FileError, match=r"file: expected an \.npz file of arrays: "):
        files.read_arrays(tmp_path / "file")


def test_pickles_are_not_opened(tmp_path):
    np.savez(tmp_path / "objects.npz", a=np.array([{}], object))
    with pytest.raises(FileError, match=r"expected an \.npz file of arrays"):
        files.read_arrays(tmp_path / "objects.npz")


def test_what_is_no_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for name in ("pipe", ".", "nothing"):
        with pytest.raises(FileError, match=r"is no file, expected one|cannot be read: (Is a directory|No such file)"):
            files.read_bytes(tmp_path / name)


def test_permissions_are_those_of_other_files(tmp_path):
    """Compares with a file and a folder that Python makes: the umask decides."""
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    files.write_json(tmp_path / "mine", 1)
    with files.creating(tmp_path / "mine_too"):
        pass
    assert (tmp_path / "mine").stat().st_mode == (tmp_path / "file").stat().st_mode
    assert (tmp_path / "mine_too").stat().st_mode == (tmp_path / "folder").stat().st_mode
    assert json.loads((tmp_path / "mine").read_text()) == 1
