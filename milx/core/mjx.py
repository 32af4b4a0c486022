"""MJX, imported without the messages that it prints about its optional packages that are not installed."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    from mujoco import mjx

__all__ = ["mjx"]
