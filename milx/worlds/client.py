"""The other end of `worker.py`: starts a world's process, asks it, and ends it when it fails or takes too long."""

import contextlib
import os
import pathlib
import select
import signal
import subprocess
import tempfile
import time
from typing import Any

import numpy as np

from milx.worlds import worker

_TAIL = 2000


class WorldError(ValueError):
    """A world that cannot be started, has failed, or has not answered in time."""


class Client:
    """A world in a process of its own.

    Args:
        make: "module:function", as `worker.py` describes it.
        python: the interpreter that runs it.
        timeout: seconds that an answer may take.

    Raises:
        WorldError: if it cannot be started; the message holds what it said.
    """

    def __init__(self, make: str, python: str, timeout: float):
        self._make, self._timeout = make, timeout
        self._said = tempfile.TemporaryFile()  # noqa: SIM115
        command = [python, str(pathlib.Path(worker.__file__).resolve()), make]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": self._said}
        try:
            # In a session of its own it does not get Ctrl-C, and can be ended with all that it has started.
            self._process = subprocess.Popen(command, start_new_session=True, **pipes)  # type: ignore[call-overload]
        except OSError as error:
            raise WorldError(f"python: {python} cannot be run: {error.strerror}") from error
        hello, _ = self._receive()
        if hello.get("protocol") != worker.PROTOCOL:
            self.close()
            raise WorldError(f"{make}: speaks protocol {hello.get('protocol')!r:.20}, expected {worker.PROTOCOL}")

    def ask(self, request: dict[str, Any], **arrays: np.ndarray) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Sends a request and waits for the answer.

        Returns:
            The answer's values and arrays.

        Raises:
            WorldError: if the world says that something went wrong, has ended, or does not answer in time. It is ended
                then.
        """
        try:
            worker.send(self._process.stdin, request, arrays)
        except OSError:
            self._fail("has ended")
        return self._receive()

    def close(self) -> None:
        """Ends the process, and all that it has started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        for file in (self._process.stdin, self._process.stdout, self._said):
            if file is not None:
                with contextlib.suppress(OSError):  # what could not be sent
                    file.close()

    def _receive(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        deadline, output = time.monotonic() + self._timeout, self._process.stdout
        assert output is not None
        ready = select.poll()
        ready.register(output, select.POLLIN)

        def read(size: int) -> bytes:
            parts: list[bytes] = []
            while size:
                left = deadline - time.monotonic()
                if left <= 0 or not ready.poll(1000 * left):
                    self._fail(f"has not answered within {self._timeout:g} s")
                part = os.read(output.fileno(), min(size, 1 << 20))
                if not part:
                    self._fail("has ended")
                parts.append(part)
                size -= len(part)
            return b"".join(parts)

        try:
            header, arrays = worker.receive(read)
        except WorldError:
            raise
        except Exception as error:  # what came is no message
            self.close()
            raise WorldError(f"{self._make}: expected a message of the protocol: {error!r:.200}") from error
        if "error" in header:
            self.close()
            raise WorldError(f"{self._make}: {header['error'].strip()[-_TAIL:]}")
        return header, arrays

    def _fail(self, how: str) -> None:
        self._said.seek(0)
        said = self._said.read().decode(errors="replace").strip()[-_TAIL:]
        try:
            ended = f" (exit code {self._process.wait(0.5)})"
        except subprocess.TimeoutExpired:  # it hangs
            ended = ""
        self.close()
        raise WorldError(f"{self._make}: {how}{ended}{': ' if said else ''}{said}")
