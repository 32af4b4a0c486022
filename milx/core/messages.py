"""Messages for people, which may quote names and values of files that somebody else wrote."""

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any, NoReturn, TextIO


def printable(text: str) -> str:
    """Escapes characters that a terminal would obey or cannot show; line breaks stay."""
    return "".join(c if c == "\n" or c.isprintable() else ascii(c)[1:-1] for c in text)


def say(message: str, file: TextIO | None = None) -> None:
    """Prints a message of milx, to the standard output if no file is given; one that is closed is left alone."""
    with contextlib.suppress(OSError, ValueError):
        print(f"milx: {printable(message)}", file=file, flush=True)


def warn(message: str) -> None:
    """Prints a message of milx to the standard error."""
    say(message, sys.stderr)


def fail(error: Exception | str) -> NoReturn:
    """Ends the process with exit code 1 and a message instead of a traceback."""
    sys.exit(f"milx: {printable(str(error))}")


@contextlib.contextmanager
def unread_output() -> Iterator[None]:
    """Lets the process go on when its output cannot be written any more, as when its terminal has been closed."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = (stream and _Unbroken(stream) for stream in before)
    try:
        yield
    finally:
        for stream in (sys.stdout, sys.stderr):
            if stream:
                stream.flush()  # at the exit of the process a failure would change its exit code
        sys.stdout, sys.stderr = before


class _Unbroken:
    """A stream of text that is written to nowhere once it has failed."""

    def __init__(self, stream: Any):
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        try:
            return self._stream.write(text)
        except OSError:
            self._give_up()
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except OSError:
            self._give_up()

    def _give_up(self) -> None:
        """Puts the null device in the place of the stream's file, for what is in buffers, too."""
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, self._stream.fileno())
        os.close(null)
