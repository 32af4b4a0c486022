"""What training writes down as it goes: metrics.jsonl, and events for TensorBoard."""

import json
import pathlib

from tensorboardX import SummaryWriter

from milx import report


class MetricsWriter:
    """Writes numbers to metrics.jsonl and to TensorBoard events.

    Args:
        folder: the run's.
        step: where the run continues; lines after it are from before an interruption and are dropped.
    """

    def __init__(self, folder: pathlib.Path, step: int):
        path = folder / "metrics.jsonl"
        lines = [line for line in report.read_metrics(path) if line["step"] <= step] if path.is_file() else []
        partial = path.with_suffix(".partial")
        partial.write_text("".join(json.dumps(line) + "\n" for line in lines))
        partial.replace(path)
        self._file = path.open("a", buffering=1)
        self._events = SummaryWriter(str(folder), purge_step=step + 1)

    def write(self, step: int, values: dict[str, float]) -> None:
        """Writes one line."""
        self._file.write(json.dumps({"step": step, **values}) + "\n")
        for name, value in values.items():
            self._events.add_scalar(name, value, step)

    def close(self) -> None:
        """Flushes and closes both."""
        self._file.close()
        self._events.close()
