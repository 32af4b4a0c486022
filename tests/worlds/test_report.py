"""What is said of episodes in other worlds: rates by control and by family, and what was lost."""

import io

import pytest
from rich.console import Console

from milx.evaluation.intervals import wilson_interval
from milx.worlds import report, summarize
from milx.worlds.actor import CONTROLS
from milx.worlds.slot import Episode, Outcome, Task


def in_words(successes, episodes):
    low, high = wilson_interval(successes, episodes)
    return f"{successes / episodes:.1%} ({100 * low:.0f} to {100 * high:.0f})"


def test_lost_episodes_count_as_episodes_without_success():
    tasks = [Task("a", "[/one]"), Task("b", "two\x1b[31m")]
    outcomes = [
        Outcome(Episode("own", 0, 0), ever=True, end=True, steps=4),
        Outcome(Episode("own", 0, 1), ever=True, end=False, steps=6),
        Outcome(Episode("own", 1, 0), steps=2, lost="it has ended"),
        Outcome(Episode("random", 1, 0), steps=8),
    ]
    found = summarize(outcomes, tasks)
    assert list(found) == ["own", "random"]
    own = found["own"]
    assert (own["episodes"], own["lost"], own["steps"]) == (3, 1, 4)
    assert (own["ever"], own["end"]) == (pytest.approx(2 / 3), pytest.approx(1 / 3))
    assert own["ever_wilson95"] == wilson_interval(2, 3)
    assert {name: (rates["episodes"], rates["ever"]) for name, rates in own["families"].items()} == {
        "[/one]": (2, 1.0),
        "two\x1b[31m": (1, 0.0),
    }
    console = Console(file=io.StringIO(), width=200)
    console.print(report.table(found))
    said = console.file.getvalue()
    assert "[/one]" in said and "two\\x1b[31m" in said
    line = next(line for line in said.splitlines() if CONTROLS["own"] in line)
    assert [cell.strip() for cell in line.strip("│").split("│")] == [
        CONTROLS["own"],
        in_words(2, 3),
        in_words(1, 3),
        "3, 1 lost",
        in_words(2, 2),
        in_words(0, 1),
    ]
    narrow = Console(file=io.StringIO(), width=60)
    narrow.print(report.table(found))
    assert "…" not in narrow.file.getvalue()
    assert report.losses(outcomes, tasks) == ["b, own, seed 0: it has ended"]
