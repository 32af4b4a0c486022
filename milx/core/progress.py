"""Progress of long phases: bars on a terminal or in a notebook, elsewhere a line now and then.

A phase may hold others, as training holds validations. Code that does the work calls `advance`, which tells the
innermost phase of its thread, and does nothing where no phase is shown.
"""

import contextlib
import contextvars
import threading
import time
from collections.abc import Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

INTERVAL = 15.0
"""Seconds between two lines where there is no terminal."""


class Phase:
    """How far a phase is.

    Args:
        description: what is done.
        total: number of items to do; None if they are not counted.
        done: number of items that were done before.
    """

    def __init__(self, description: str, total: int | None, done: int):
        self.description, self._total, self._done, self._note = description, total, done, ""
        self._began = time.perf_counter()
        self._first: tuple[float, int] | None = None  # when the first items were done, and how many there were then

    def advance(self, count: int, note: str = "") -> None:
        """Counts items as done; those beyond the total are ignored."""
        self._done += count
        if self._total is not None:
            self._done = min(self._done, self._total)
        self._note = note or self._note
        self._first = self._first or (time.perf_counter(), self._done)

    @property
    def fraction(self) -> float | None:
        """The fraction that is done; None if items are not counted."""
        return None if self._total is None else self._done / max(self._total, 1)

    def __str__(self) -> str:
        """Says how many items are done, at what rate, and about how long the others will take."""
        if self._total is None or self._first is None:
            return ""
        parts = [f"{self._done:,} of {self._total:,}"]
        elapsed, count = time.perf_counter() - self._first[0], self._done - self._first[1]
        if count and elapsed:  # the first items took longer: their time includes compilation
            rate = count / elapsed
            parts += [f"{rate:.3g}/s", f"{(self._total - self._done) / rate:.0f} s left"]
        return ", ".join([*parts, self._note] if self._note else parts)

    @property
    def seconds(self) -> float:
        """Seconds since it began."""
        return time.perf_counter() - self._began


class _Bars:
    """A bar for every phase."""

    def __init__(self, console: Console):
        columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TextColumn("{task.fields[text]}")
        self._bars = Progress(*columns, console=console, transient=True)
        self._tasks: list[TaskID] = []
        self.phases: list[Phase] = []

    def start(self) -> None:
        self._bars.start()

    def stop(self) -> None:
        self._bars.stop()

    def push(self, phase: Phase) -> None:
        self._tasks.append(self._bars.add_task(phase.description, total=None, text=""))
        self.phases.append(phase)
        self.update()

    def pop(self) -> None:
        self._bars.remove_task(self._tasks.pop())
        self.phases.pop()

    def update(self) -> None:
        phase = self.phases[-1]
        total = None if phase.fraction is None else 1.0
        self._bars.update(self._tasks[-1], total=total, completed=phase.fraction or 0.0, text=str(phase))


class _Lines:
    """A line about the innermost phase every INTERVAL seconds."""

    def __init__(self, console: Console):
        self._console, self._end = console, threading.Event()
        self.phases: list[Phase] = []
        self._thread = threading.Thread(target=self._print, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._end.set()
        self._thread.join()

    def push(self, phase: Phase) -> None:
        self.phases.append(phase)

    def pop(self) -> None:
        self.phases.pop()

    def update(self) -> None:
        """Prints nothing: the thread reads the phase."""

    def _print(self) -> None:
        while not self._end.wait(INTERVAL):
            for phase in self.phases[-1:]:
                text = ", ".join(filter(None, (f"{phase.seconds:.0f} s", str(phase))))
                self._console.print(f"{phase.description}: {text}", highlight=False, markup=False)


_display: contextvars.ContextVar[_Bars | _Lines | None] = contextvars.ContextVar("display", default=None)


@contextlib.contextmanager
def phase(console: Console, description: str, total: int | None = None, done: int = 0) -> Iterator[None]:
    """Shows a phase on the console as long as it takes.

    Args:
        console: where to show it; within another phase it is shown where that one is.
        description: what is done.
        total: number of items to do; None if they are not counted.
        done: number of items that were done before.
    """
    outer = _display.get()
    display = outer or (_Bars(console) if console.is_terminal or console.is_jupyter else _Lines(console))
    if outer is None:
        display.start()
    display.push(Phase(description, total, done))
    token = _display.set(display)
    try:
        yield
    finally:
        _display.reset(token)
        display.pop()
        if outer is None:
            display.stop()


def advance(count: int, note: str = "") -> None:
    """Counts items of the innermost phase as done.

    Args:
        count: how many.
        note: what else to show of them; the last note stays.
    """
    display = _display.get()
    if display is not None:
        display.phases[-1].advance(count, note)
        display.update()
