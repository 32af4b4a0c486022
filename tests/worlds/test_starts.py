"""Worlds that cannot be started or fail to demonstrate a task cost episodes, and not the evaluation."""

import re
import sys

import numpy as np
import pytest
from follower import WORLDS, alone, interpreter

from milx.types import Demo, Spec
from milx.worlds import evaluate
from milx.worlds.actor import CONTROLS
from milx.worlds.client import WorldError
from milx.worlds.evaluate import evaluate_in
from milx.worlds.slot import Episode, Slot, Task

SHOWN = (Demo(state=np.ones((6, 2)), action=np.zeros((6, 2))),)
TASK = Task("near/right", "near", SHOWN)


@pytest.fixture(autouse=True)
def folder(monkeypatch):
    monkeypatch.chdir(WORLDS)


def starting_once(folder):
    """Makes an interpreter of which only the first process starts; every process leaves a line in the file `starts`."""
    return interpreter(folder / "python", f"cd {folder}\necho once >> starts\nmkdir taken || exit 7\ncd {WORLDS}")


def test_a_world_that_fails_to_start_is_tried_again(policy, tmp_path):
    """Lets the first two processes fail: whichever of the two worlds they belong to, a third attempt is left."""
    python = interpreter(tmp_path / "python", f"mkdir {tmp_path}/a && exit 7\nmkdir {tmp_path}/b && exit 7")
    outcomes = evaluate_in(policy, "point_world:make", [TASK], controls=["own"], episodes=4, workers=2, python=python)
    assert [(outcome.lost, outcome.end) for outcome in outcomes] == [(None, True)] * 4
    assert (tmp_path / "b").exists()


def test_a_world_that_cannot_be_started_leaves_its_episodes_to_the_others(policy, tmp_path):
    """Lets one of three worlds start, which runs all episodes."""
    python = starting_once(tmp_path)
    outcomes = evaluate_in(policy, "point_world:make", [TASK], controls=["own"], episodes=8, workers=3, python=python)
    assert [(outcome.lost, outcome.end) for outcome in outcomes] == [(None, True)] * 8
    assert len((tmp_path / "starts").read_text().split()) == 1 + 2 * 3, "attempts"


def test_no_world_that_can_be_started_is_an_error(policy, tmp_path):
    python = interpreter(tmp_path / "python", f"echo once >> {tmp_path}/starts\necho no memory >&2\nexit 7")
    message = r"could not be started in 3 attempts: point_world:make: has ended \(exit code 7\): no memory"
    with pytest.raises(WorldError, match=message):
        evaluate_in(policy, "point_world:make", [TASK], workers=2, python=python)
    assert len((tmp_path / "starts").read_text().split()) == 2 * 3, "attempts"


def test_what_was_done_is_kept_when_no_world_can_be_started_again(policy, tmp_path):
    """Ends the only world in the second of four episodes, and lets no other one start."""
    outcomes = evaluate_in(
        policy,
        "point_world:make_frail",
        [TASK],
        controls=["own"],
        episodes=4,
        seed=0,
        workers=1,
        python=starting_once(tmp_path),
    )
    assert [outcome.end for outcome in outcomes] == [True, False, False, False]
    assert outcomes[0].lost is None
    assert "has ended (exit code 7)" in outcomes[1].lost and "attempts" not in outcomes[1].lost
    for outcome in outcomes[2:]:
        assert outcome.lost.startswith("the world could not be started in 3 attempts: point_world:make_frail: ")
    assert len((tmp_path / "starts").read_text().split()) == 1 + 3, "attempts"


def test_episodes_of_which_none_has_begun_are_an_error(policy, tmp_path):
    """Ends the only world in its first reset, and lets no other one start."""
    python = starting_once(tmp_path)
    with pytest.raises(WorldError, match=r"all 4 episodes were lost: .*has ended \(exit code 7\)"):
        evaluate_in(
            policy, "point_world:make_frail", [TASK], controls=["own"], episodes=4, seed=1, workers=1, python=python
        )


class Dying:
    """A world that ends when it is asked, and cannot be started again."""

    def __init__(self):
        self.started = False

    def connect(self):
        if self.started:
            raise WorldError("no more")
        self.started = True
        return self

    def ask(self, request):
        raise WorldError("has ended")

    def close(self):
        pass


class Showing:
    """A world that shows every task."""

    def ask(self, request):
        return {}, {"state": np.ones((6, 2)), "action": np.zeros((6, 2))}

    def close(self):
        pass


def test_a_world_that_was_closed_is_not_started_again():
    world = Dying()
    slot = Slot(world.connect, Spec(None, 2, 2, None, ()), 6)
    slot.close()
    slot.start()
    assert not world.started and slot.problem == "the evaluation has ended"


def test_another_world_shows_what_comes_after_the_task_in_whose_demonstration_one_has_ended():
    tasks, spec = [Task(name) for name in ("a", "b", "c")], Spec(None, 2, 2, None, ())
    slots = [Slot(connect, spec, 6) for connect in (Dying().connect, Showing)]
    shown, missing = evaluate._demonstrated(slots, tasks, 0)
    assert missing == {0: "the task has no demonstration: has ended"}
    assert [len(task.demos) for task in shown] == [0, 1, 1]
    with pytest.raises(WorldError, match="the task has no demonstration: has ended"):
        evaluate._demonstrated([Slot(Dying().connect, spec, 6)], tasks, 0)


def test_a_task_that_the_world_fails_to_demonstrate_costs_its_own_episodes(policy):
    """Lets a world show three of four tasks: its episodes end as they do where only these stand in for each other."""
    tasks = [Task(name, name.partition("/")[0]) for name in ("near/left", "far/right", "far/left", "near/right")]
    outcomes = evaluate_in(policy, "point_world:make_frail", tasks, episodes=2, seed=100, workers=2)
    there = [task if task.name == "far/right" else task._replace(demos=SHOWN) for task in tasks]
    expected = [
        Episode(control, number, seed)
        for number, task in enumerate(tasks)
        for control in CONTROLS
        for seed in (100, 101)
        if (task.name, control) != ("far/left", "same_family")
    ]
    assert [outcome.episode for outcome in outcomes] == expected
    for outcome in outcomes:
        if outcome.episode.task == 1:
            assert re.match(r"(?s)the task has no demonstration: .*ValueError: nobody can show this", outcome.lost)
            assert (outcome.ever, outcome.end, outcome.steps) == (False, False, 0)
        else:
            assert outcome.lost is None
            assert (outcome.ever, outcome.end) == alone(there, outcome.episode, demo_seed=109), outcome.episode
    assert any(outcome.end for outcome in outcomes)


def test_a_world_that_demonstrates_nothing_is_an_error(policy):
    """Ends the world's process in every demonstration, then asks a world that shows no actions."""
    tasks = [Task("near/left"), Task("far/left")]
    with pytest.raises(WorldError, match=r"the task has no demonstration: .*has ended \(exit code 7\)"):
        evaluate_in(policy, "point_world:make_frail", tasks, seed=1, workers=1)
    with pytest.raises(
        WorldError, match=r"demonstration of 'near/left': got \['state'\], expected an action, at least"
    ):
        evaluate_in(policy, "point_world:make_idle", tasks, workers=1)
    with pytest.raises(ValueError, match="tasks: got none, expected at least one"):
        evaluate_in(policy, "point_world:make", [])


def test_worlds_run_in_the_interpreter_that_is_chosen(policy, tmp_path):
    """Tells the goal, to which the policy goes, to the processes of that interpreter alone."""
    python = interpreter(tmp_path / "python", "export POINT_WORLD_GOAL=1,1")
    for chosen, done in ((python, True), (sys.executable, False)):
        outcomes = evaluate_in(
            policy, "point_world:make_told", [TASK], controls=["own"], episodes=3, workers=2, python=chosen
        )
        assert [(outcome.lost, outcome.end) for outcome in outcomes] == [(None, done)] * 3
