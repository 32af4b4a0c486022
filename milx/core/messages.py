"""Messages for people, which may quote names and values of files that somebody else wrote."""

import sys
from typing import NoReturn


def printable(text: str) -> str:
    """Escapes characters that a terminal would obey or cannot show; line breaks stay."""
    return "".join(c if c == "\n" or c.isprintable() else ascii(c)[1:-1] for c in text)


def fail(error: Exception | str) -> NoReturn:
    """Ends the process with exit code 1 and a message instead of a traceback."""
    sys.exit(f"milx: {printable(str(error))}")
