"""How milx's commands end: with a message and an exit code, never with a traceback for what is not milx's fault."""

import contextlib
from collections.abc import Iterator

from milx.core import messages, signals


@contextlib.contextmanager
def command() -> Iterator[None]:
    """Surrounds the work of a command.

    Bad input, and files that cannot be read or written, end it with a message and exit code 1, and a signal with 128
    plus its number (see `signals.Stop`). Output that cannot be written is given up, and the work goes on.
    """
    with messages.unread_output():
        try:
            with signals.Stop().listen():
                yield
        except (ValueError, OSError) as error:
            messages.fail(error)
