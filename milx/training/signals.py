"""Guards of a run's folder and of its process: one trainer at a time, and a stop that loses nothing."""

import contextlib
import fcntl
import os
import pathlib
import signal
import socket
import threading
from collections.abc import Iterator


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

    Within `deferred` a signal is noted and `asked` becomes true; elsewhere within `listen` it ends the process at once,
    even while the main thread waits for a device.
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
        ours, theirs = socket.socketpair()
        theirs.setblocking(False)
        # Python's own handlers wait for the main thread; what it writes to a socket, another thread reads at once.
        before = signal.signal(signal.SIGTERM, lambda *_: None), signal.set_wakeup_fd(theirs.fileno())
        watcher = threading.Thread(target=self._watch, args=(ours,), daemon=True)
        watcher.start()
        try:
            yield
        finally:
            signal.set_wakeup_fd(before[1])
            signal.signal(signal.SIGTERM, before[0])
            theirs.close()
            watcher.join()
            ours.close()

    @contextlib.contextmanager
    def deferred(self) -> Iterator[None]:
        """Lets what is under way come to its end first."""
        self._deferred = True
        try:
            yield
        finally:
            self._deferred = False

    def _watch(self, ours: socket.socket) -> None:
        while numbers := ours.recv(64):
            if signal.SIGTERM in numbers:
                self.asked = True
                if not self._deferred:
                    print("milx: stopped; the same command goes on", flush=True)
                    # Threads that compile would keep a process alive that ends in the usual way.
                    os._exit(0)
