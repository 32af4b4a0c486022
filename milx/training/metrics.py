"""What training writes down as it goes: metrics.jsonl, and events for TensorBoard."""

import contextlib
import json
import pathlib
from collections.abc import Callable
from typing import Any

from tensorboardX import SummaryWriter


class MetricsWriter:
    """Writes numbers to metrics.jsonl and to TensorBoard events.

    Args:
        folder: the run's.
        step: where the run continues; lines after it are from before an interruption and are dropped.
        warn: told of a line that cannot be written, say on a full disk, and is left out.
    """

    def __init__(self, folder: pathlib.Path, step: int, warn: Callable[[str], None]):
        self._warn = warn
        path = folder / "metrics.jsonl"
        lines = [line for line in read_metrics(path) if line["step"] <= step] if path.is_file() else []
        partial = path.with_suffix(".partial")
        partial.write_text("".join(json.dumps(line) + "\n" for line in lines))
        partial.replace(path)
        self._file = path.open("a", buffering=1)
        self._events = SummaryWriter(str(folder), purge_step=step + 1)

    def write(self, step: int, values: dict[str, float]) -> None:
        """Writes one line."""
        try:
            self._file.write(json.dumps({"step": step, **values}) + "\n")
        except OSError as error:
            self._warn(f"metrics of step {step} could not be written: {error}")
        for name, value in values.items():
            self._events.add_scalar(name, value, step)

    def close(self) -> None:
        """Flushes and closes both."""
        for file in (self._file, self._events):
            with contextlib.suppress(OSError):  # was reported when it was written
                file.close()


def read_metrics(path: pathlib.Path) -> list[dict[str, Any]]:
    """Reads the lines of a metrics.jsonl file that are whole: a kill or a full disk may have left half a line."""
    lines = []
    for line in path.read_text().splitlines():
        with contextlib.suppress(ValueError):
            lines.append(json.loads(line))
    return [line for line in lines if isinstance(line, dict) and "step" in line]
