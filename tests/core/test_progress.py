"""Progress: what is shown of phases, on a terminal and elsewhere."""

import io
import re
import threading

import jax.numpy as jnp
import pytest
from rich.console import Console

from milx.core import progress
from milx.core.batching import map_in_chunks


@pytest.fixture
def clock(monkeypatch):
    """Replaces the clock by one that a test sets."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now[0])
    return now


def test_rate_and_time_left_leave_the_first_items_out(clock):
    phase = progress.Phase("planning", total=1000, done=0)
    assert str(phase) == ""
    clock[0] += 30  # compilation and the first hundred
    phase.advance(100)
    assert str(phase) == "100 of 1,000"
    clock[0] += 10
    phase.advance(500, "loss 0.5")
    assert str(phase) == "600 of 1,000, 50/s, 8 s left, loss 0.5"
    phase.advance(700)
    assert phase.fraction == 1.0
    assert str(phase).startswith("1,000 of 1,000")


def test_without_a_terminal_the_innermost_phase_has_a_line_every_interval(monkeypatch):
    monkeypatch.setattr(progress, "INTERVAL", 0.01)
    written, seen = io.StringIO(), threading.Event()
    console = Console(file=written, width=100)

    def wait_for(text):
        for _ in range(1000):
            if re.search(text, written.getvalue()):
                return
            seen.wait(0.01)
        raise AssertionError(f"{text!r} is not in {written.getvalue()!r}")

    with progress.phase(console, "training", total=4):
        progress.advance(3, "loss 0.1")
        wait_for(r"^training: \d+ s, 3 of 4, loss 0.1$".replace("^", "(?m:^)").replace("$", "(?m:$)"))
        with progress.phase(console, "validating"):
            progress.advance(1)
            wait_for(r"(?m:^)validating: \d+ s(?m:$)")
        length = len(written.getvalue())
        progress.advance(1)
        wait_for("training: .* 4 of 4")
        assert "validating" not in written.getvalue()[length:].split("\n", 1)[1]
    length = len(written.getvalue())
    seen.wait(0.05)
    assert len(written.getvalue()) == length, "nothing is printed once the phase is over"


def test_a_terminal_shows_a_bar_for_every_phase_and_clears_them():
    written = io.StringIO()
    console = Console(file=written, force_terminal=True, width=120, _environ={"TERM": "xterm"})
    with progress.phase(console, "training", total=8):
        progress.advance(4)
        with progress.phase(console, "validating", total=2):
            progress.advance(1)
    text = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written.getvalue())
    assert "training" in text and "validating" in text and "4 of 8" in text
    assert written.getvalue().removesuffix("\x1b[?25h\r").endswith("\x1b[1A\x1b[2K"), "the bars are erased"


def test_chunks_count_as_done_in_the_phase_around_them():
    console = Console(file=io.StringIO())
    with progress.phase(console, "mapping", total=10):
        map_in_chunks(lambda x: 2 * x, (jnp.arange(10),), 4)
        assert progress._display.get().phases[0].fraction == 1.0
    progress.advance(3)  # does nothing where no phase is shown
    assert progress._display.get() is None
