"""MJX, imported without the lines that it prints for each of its own optional packages that is not installed."""

import contextlib
import io

with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    from mujoco import mjx

__all__ = ["mjx"]
