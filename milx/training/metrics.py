"""What training writes down as it goes: metrics.jsonl, events for TensorBoard, and Weights & Biases."""

import contextlib
import json
import pathlib
import time
from collections.abc import Callable, Iterator
from typing import Any, Self

from tensorboardX import summary
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event, SessionLog

from milx.core import files
from milx.core.files import FileError
from milx.training.tracking import Tracker


class MetricsWriter:
    """Writes numbers to metrics.jsonl and to TensorBoard events.

    Both are written before `write` returns, without threads or queues. What cannot be written, for example on a full
    disk, is reported and left out; TensorBoard's file and wandb, once they have failed, are not tried any more. Used in
    a `with` statement, at whose end both are closed.

    Args:
        folder: the run's.
        step: where the run continues; lines after it are from before an interruption and are dropped.
        warn: told of what cannot be written.
        track: starts to send metrics elsewhere, too; None for nowhere.
    """

    def __init__(
        self,
        folder: pathlib.Path,
        step: int,
        warn: Callable[[str], None],
        track: Callable[[], Tracker] | None = None,
    ):
        self._warn, self._path = warn, folder / "metrics.jsonl"
        self._events: EventsWriter | None = None
        lines = [line for line in read_metrics(self._path) if line["step"] <= step] if self._path.is_file() else []
        with self._reported("metrics"):
            files.write_bytes(self._path, "".join(json.dumps(line) + "\n" for line in lines).encode())
        with self._reported("TensorBoard's events"):
            self._events = EventsWriter(str(folder / "events"), f".{step}")
            # TensorBoard drops what an interrupted run wrote from this step on.
            self._events.write_event(
                Event(step=step + 1, wall_time=time.time(), session_log=SessionLog(status=SessionLog.START))
            )
        self._tracker: Tracker | None = None
        if track is not None:
            with self._reported("wandb's metrics", (Exception,)):
                self._tracker = track()

    def write(self, step: int, values: dict[str, float]) -> None:
        """Writes one line."""
        with self._reported(f"metrics of step {step}"):
            files.append(self._path, json.dumps({"step": step, **values}) + "\n")
        if self._tracker is not None:
            tracker, self._tracker = self._tracker, None  # unless all goes well
            with self._reported("wandb's metrics", (Exception,)):
                tracker.log(step, values)
                self._tracker = tracker
        if self._events is None:
            return
        events, self._events = self._events, None  # unless all goes well
        with self._reported("TensorBoard's events"):
            for name, value in values.items():
                events.write_event(Event(step=step, wall_time=time.time(), summary=summary.scalar(name, value)))
            events.flush()
            self._events = events

    def __enter__(self) -> Self:
        return self

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        """Closes TensorBoard's file, and waits for wandb, which is told whether there was an error."""
        if self._tracker is not None:
            with self._reported("wandb's metrics", (Exception,)):
                self._tracker.close(failed=error is not None)
        if self._events is not None:
            with self._reported("TensorBoard's events"):
                self._events.close()

    @contextlib.contextmanager
    def _reported(self, what: str, errors: tuple[type[Exception], ...] = (FileError, OSError)) -> Iterator[None]:
        try:
            yield
        except errors as error:
            self._warn(f"{what} could not be written: {error}")


def read_metrics(path: pathlib.Path) -> list[dict[str, Any]]:
    """Reads the lines of a metrics.jsonl file that are whole: a kill or a full disk may have left half a line."""
    lines = []
    for line in files.read_bytes(path).splitlines():
        with contextlib.suppress(ValueError, RecursionError):
            lines.append(json.loads(line))
    return [line for line in lines if isinstance(line, dict) and isinstance(line.get("step"), int)]
