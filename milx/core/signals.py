"""A stop that loses nothing: the signals that tell a run to end."""

import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator

from milx.core.messages import say

_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
"""The signals that tell a run to stop."""


class Stop:
    """Which signal told the process to end: SIGTERM, SIGINT (Ctrl-C) or SIGHUP (a terminal that closes).

    Within `deferred` a signal is noted, and a second SIGINT ends the process at once; elsewhere within `listen` the
    first one does, even while the main thread waits for a device. In an interactive session SIGINT raises
    KeyboardInterrupt there instead. Signals that were ignored before (by `nohup`, for example) remain so. A process
    that has been stopped exits with 128 plus the number of the signal, as a shell reports it.

    Args:
        message: what is said when a signal ends the process at once.
    """

    def __init__(self, message: str = "stopped") -> None:
        self._message = message
        self.asked = 0
        """The number of the first signal; 0 before."""
        self._deferred = False

    @property
    def exit_code(self) -> int:
        """The code to exit with; that of SIGTERM if another host was told to stop."""
        return 128 + (self.asked or signal.SIGTERM)

    @contextlib.contextmanager
    def listen(self) -> Iterator[None]:
        """Listens for the signals; not in threads, where Python cannot."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        ours, theirs = socket.socketpair()
        theirs.setblocking(False)
        before = {number: signal.getsignal(number) for number in _SIGNALS}
        heard = [number for number in _SIGNALS if before[number] != signal.SIG_IGN]
        for number in heard:
            signal.signal(number, self._interrupt)
        # Python's own handlers wait for the main thread; what it writes to a socket, another thread reads at once.
        wakeup = signal.set_wakeup_fd(theirs.fileno())
        watcher = threading.Thread(target=self._watch, args=(ours,), daemon=True)
        watcher.start()
        try:
            yield
        finally:
            signal.set_wakeup_fd(wakeup)
            for number in heard:
                signal.signal(number, before[number])
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

    def _interrupt(self, number: int, _: object) -> None:
        """Runs in the main thread once that is back in Python; `_watch` does the rest in its own thread."""
        if number == signal.SIGINT and _is_interactive() and not self._deferred:
            raise KeyboardInterrupt

    def _watch(self, ours: socket.socket) -> None:
        while numbers := ours.recv(64):
            for number in numbers:
                if number in _SIGNALS:
                    self._note(number)

    def _note(self, number: int) -> None:
        again, self.asked = self.asked, self.asked or number
        if self._deferred and not (again and number == signal.SIGINT):
            if number == signal.SIGINT and not _is_interactive():
                _say("stopping after the updates under way; Ctrl-C again ends at once")
        elif number != signal.SIGINT or not _is_interactive():
            _say(self._message)
            # Threads that compile would keep a process alive that ends in the usual way.
            os._exit(128 + number)


def _say(message: str) -> None:
    """Says a message, for at most a second: nobody may read a pipe, and writing to it would take for ever."""
    thread = threading.Thread(target=say, args=(message,), daemon=True)
    thread.start()
    thread.join(1.0)


def _is_interactive() -> bool:
    """Tells whether a person has a prompt or a notebook, which must outlive an interrupted run."""
    return hasattr(sys, "ps1")
