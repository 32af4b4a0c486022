"""Files, read and written in one way: whole or not there, of bounded size, and never through a link.

What is written gets a temporary name of its own, reaches the disk, and is renamed then. The file of a process that
failed or was killed stays what it was before. Leftovers of killed processes are removed by the next one that writes
beside them: a process holds a lock on its temporary files for as long as it lives.
"""

import contextlib
import fcntl
import hashlib
import io
import json
import os
import pathlib
import re
import secrets
import shutil
import socket
import stat
import zipfile
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

MAX_BYTES = 1 << 33
"""The most that is read at once, in bytes. A larger file is refused before memory is allocated for it."""
MAX_JSON_BYTES = 1 << 26
_LEFTOVER = re.compile(r"\..+\.[0-9a-f]{16}\.partial")
"""The names of temporary files and folders."""


class FileError(ValueError):
    """A file that cannot be read or written, or does not hold what it should. The message begins with its path."""


def write_bytes(path: pathlib.Path, content: bytes) -> None:
    """Writes a file, or replaces it, as a whole.

    Raises:
        FileError: if it cannot be written, for example on a full disk; an existing file stays as it is.
    """
    with replacing(path) as partial, partial.open("wb") as file:
        file.write(content)


def write_json(path: pathlib.Path, values: Any) -> None:
    """Writes values as indented JSON, as `write_bytes` does."""
    write_bytes(path, (json.dumps(values, indent=1) + "\n").encode())


def write_arrays(path: pathlib.Path, arrays: Mapping[str, np.ndarray], *, compress: bool = True) -> None:
    """Writes arrays by name as an .npz file, as `write_bytes` does."""
    with replacing(path) as partial, partial.open("wb") as file:
        (np.savez_compressed if compress else np.savez)(file, allow_pickle=False, **arrays)


def append(path: pathlib.Path, text: str) -> None:
    """Appends to a file, which is made if it is missing. A process that is killed may leave a part of the text.

    Raises:
        FileError: if it cannot be written; the file keeps what it held before.
    """
    with _failing(path, "written"), path.open("ab", buffering=0) as file:
        end, content = file.seek(0, os.SEEK_END), text.encode()
        try:
            while content:
                content = content[file.write(content) :]
        except OSError:
            file.truncate(end)
            raise


def read_bytes(path: pathlib.Path, at_most: int = MAX_BYTES) -> bytes:
    """Reads a whole file.

    Raises:
        FileError: if it is missing, a link, no file, larger than `at_most` bytes, or cannot be read.
    """
    with _opened(path, at_most) as file:
        return file.read()


def read_json(path: pathlib.Path) -> Any:
    """Reads the values in a JSON file.

    Raises:
        FileError: as `read_bytes`, and if the file does not hold JSON.
    """
    try:
        return json.loads(read_bytes(path, MAX_JSON_BYTES))
    except FileError:
        raise
    except (ValueError, RecursionError) as error:
        raise FileError(f"{path}: expected JSON: {error}") from error


def read_arrays(path: pathlib.Path) -> dict[str, np.ndarray]:
    """Reads the arrays of an .npz file, by name.

    Raises:
        FileError: as `read_bytes`, and if the file does not hold arrays, or more than MAX_BYTES once they are unpacked.
    """
    content = io.BytesIO(read_bytes(path))
    try:
        with zipfile.ZipFile(content) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_BYTES:
            raise FileError(f"{path}: got {size / 2**30:.3g} GiB of arrays, expected at most {MAX_BYTES >> 30}")
        with np.load(content, allow_pickle=False) as arrays:
            return {name: np.asarray(arrays[name]) for name in arrays}
    except FileError:
        raise
    except Exception as error:  # zipfile, zlib and NumPy raise many types of errors on damaged bytes
        raise FileError(f"{path}: expected an .npz file of arrays: {error!r:.200}") from error


def sha256(path: pathlib.Path) -> str:
    """Computes the SHA-256 of a file's contents.

    Raises:
        FileError: as `read_bytes`.
    """
    with _opened(path, MAX_BYTES) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextlib.contextmanager
def locked(path: pathlib.Path) -> Iterator[None]:
    """Holds the lock file at `path`; it is free again when this process has ended, however it ended.

    Raises:
        FileError: if another process holds it (the message says which), it cannot be written, or the file system has no
            locks.
    """
    with _failing(path, "written"):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("ab+", buffering=0)
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            holder = file.read(200).decode(errors="replace").strip()
            raise FileError(f"{path.parent}: is in use by {holder}, expected no other process") from error
        except OSError as error:
            raise FileError(f"{path}: cannot be locked, expected a file system with locks: {error.strerror}") from error
        with _failing(path, "written"):
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}\n".encode())
        yield


@contextlib.contextmanager
def replacing(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """Gives a temporary path to write a file to, which takes the place of `path` at the end, unless an error is raised.

    Raises:
        FileError: if the file cannot be written, also for an OSError that is raised inside.
    """
    with _failing(path, "written"):
        path.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(path.parent)
        partial, lock = _claim(path, is_folder=False)
        try:
            yield partial
            _synchronize(partial)
            partial.replace(path)
            _synchronize(path.parent)
        finally:
            partial.unlink(missing_ok=True)
            os.close(lock)


@contextlib.contextmanager
def creating(folder: pathlib.Path) -> Iterator[pathlib.Path]:
    """Gives a temporary folder to write to, which becomes `folder` at the end, unless an error is raised.

    Raises:
        FileError: if the folder exists, or cannot be written, also for an OSError that is raised inside.
    """
    with _failing(folder, "written"):
        if os.path.lexists(folder):
            raise FileError(f"{folder}: exists, expected a folder that does not: nothing is written over")
        folder.parent.mkdir(parents=True, exist_ok=True)
        remove_leftovers(folder.parent)
        partial, lock = _claim(folder, is_folder=True)
        try:
            yield partial
            for path in (*partial.rglob("*"), partial):
                _synchronize(path)
            partial.rename(folder)
            _synchronize(folder.parent)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
            os.close(lock)


def remove_leftovers(folder: pathlib.Path) -> None:
    """Removes temporary files and folders whose processes have ended."""
    for path in folder.glob(".*.partial"):
        if _LEFTOVER.fullmatch(path.name):
            with contextlib.suppress(OSError):  # another process removes it, or uses it
                lock = _lock(path)
                try:
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
                finally:
                    os.close(lock)


def remove(path: pathlib.Path) -> None:
    """Removes a file, or a folder with all it holds; one that is not there need not be removed.

    Raises:
        FileError: if it cannot be removed.
    """
    with _failing(path, "removed"), contextlib.suppress(FileNotFoundError):
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def move(path: pathlib.Path, target: pathlib.Path) -> None:
    """Renames a file or a folder.

    Raises:
        FileError: if something is there already, or it cannot be renamed.
    """
    with _failing(target, "written"):
        if os.path.lexists(target):
            raise FileError(f"{target}: exists, expected nothing there: nothing is written over")
        target.parent.mkdir(parents=True, exist_ok=True)
        path.rename(target)
        _synchronize(target.parent)


def inside(root: pathlib.Path, path: str | pathlib.Path) -> pathlib.Path:
    """Finds a file by its path in a folder that may come from somebody else.

    Raises:
        FileError: if the path leads out of the folder or through a link, or there is no such file.
    """
    try:
        found = root / path
        there = found.is_file()
        within = found.resolve().is_relative_to(root.resolve())
    except (OSError, RuntimeError, ValueError) as error:  # names that are too long, links that lead to themselves
        raise FileError(f"{root}: expected a path, got {str(path)[:200]!r}: {error!r:.200}") from error
    if not within:
        raise FileError(f"{root}: {path} leads out of the folder, expected a path inside")
    if not there:
        raise FileError(f"{root}: {path} is missing, expected a file there")
    for step in (found, *found.parents):
        if step == root:
            break
        if step.is_symlink():
            raise FileError(
                f"{root}: {path} is reached through a link, expected a path without links: they are not followed"
            )
    return found


def refuse_links(folder: pathlib.Path) -> None:
    """Checks that a folder is no link and holds files and folders alone, at any depth: no link, no pipe, no device.

    Raises:
        FileError: if it holds something else, or cannot be read.
    """
    if folder.is_symlink():
        raise FileError(f"{folder}: is a link, expected a folder: links are not followed")
    waiting = [str(folder)]
    with _failing(folder, "read"):
        while waiting:
            with os.scandir(waiting.pop()) as entries:
                for entry in entries:
                    if entry.is_dir(follow_symlinks=False):
                        waiting.append(entry.path)
                    elif not entry.is_file(follow_symlinks=False):
                        kind = "a link" if entry.is_symlink() else "no file"
                        raise FileError(f"{entry.path}: is {kind}, expected a file or a folder: links are not followed")


@contextlib.contextmanager
def _opened(path: pathlib.Path, at_most: int) -> Iterator[Any]:
    with _failing(path, "read"):
        if path.is_symlink():
            raise FileError(f"{path}: is a link, expected a file: links are not followed")
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
            found = os.fstat(file.fileno())
            if not stat.S_ISREG(found.st_mode):
                raise FileError(f"{path}: is no file, expected one: folders, pipes and devices are not read")
            if found.st_size > at_most:
                raise FileError(f"{path}: got {found.st_size} bytes, expected at most {at_most}")
            yield file


@contextlib.contextmanager
def _failing(path: pathlib.Path, doing: str) -> Iterator[None]:
    """Turns errors of the operating system into a FileError."""
    try:
        yield
    except OSError as error:
        raise FileError(f"{path}: cannot be {doing}: {error.strerror or error}") from error


def _claim(path: pathlib.Path, *, is_folder: bool) -> tuple[pathlib.Path, int]:
    """Makes an empty temporary file or folder beside `path` and locks it; returns it and the lock's descriptor."""
    while True:
        partial = path.with_name(f".{path.name[:100]}.{secrets.token_hex(8)}.partial")
        partial.mkdir() if is_folder else partial.touch(exist_ok=False)
        try:
            return partial, _lock(partial)
        except (FileNotFoundError, BlockingIOError):  # another process took it for a leftover
            continue
        except OSError:
            try:  # a file system may have no locks, or none for folders: leftovers stay there
                return partial, os.open(partial, os.O_RDONLY)
            except OSError:
                partial.rmdir() if is_folder else partial.unlink()
                raise


def _lock(path: pathlib.Path) -> int:
    """Locks a file or folder.

    Raises:
        OSError: if another process has locked it or removed it.
    """
    # NFS locks only what is open for writing.
    mode = os.O_RDONLY if path.is_dir() else os.O_RDWR
    descriptor = os.open(path, mode | os.O_NOFOLLOW | os.O_NONBLOCK)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if path.stat().st_ino != os.fstat(descriptor).st_ino:
            raise FileNotFoundError(path)
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _synchronize(path: pathlib.Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
