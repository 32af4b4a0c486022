"""Guards of a run's folder and of its process: one trainer at a time, and a stop that loses nothing."""

import contextlib
import fcntl
import os
import pathlib
import signal
import socket
import threading
from collections.abc import Iterator
from types import FrameType


@contextlib.contextmanager
def one_trainer(folder: pathlib.Path) -> Iterator[None]:
    """Holds the folder's lock; it is free again when this process has ended, however it ended.

    Raises:
        ValueError: if another process holds it; the message says which.
    """
    with (folder / "lock").open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.seek(0)
            raise ValueError(
                f"workdir: {folder} is in use by {file.read().strip()}, expected no other trainer"
            ) from error
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield


class Stop:
    """Whether the process was told to end (SIGTERM), as shared machines do before they take a node away.

    Within `deferred` a signal is noted and `asked` becomes true; elsewhere it ends the process at once.
    """

    def __init__(self) -> None:
        self.asked = False
        self._deferred = False

    @contextlib.contextmanager
    def listen(self) -> Iterator[None]:
        """Listens for the signal; not in threads, where Python cannot."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = signal.signal(signal.SIGTERM, self._on_signal)
        try:
            yield
        finally:
            signal.signal(signal.SIGTERM, before)

    @contextlib.contextmanager
    def deferred(self) -> Iterator[None]:
        """Lets what is under way come to its end first."""
        self._deferred = True
        try:
            yield
        finally:
            self._deferred = False

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        del number, frame
        self.asked = True
        if not self._deferred:
            print("milx: stopped before the first update; the same command starts again", flush=True)
            # Threads that compile would keep a process alive that ends in the usual way.
            os._exit(0)
