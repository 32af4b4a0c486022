"""Evaluation in worlds that are not milx's, against the same episodes one after the other in this process."""

import dataclasses
import io
import json
import os
import pathlib
import re
import subprocess
import sys
import textwrap
import time

import imageio.v3 as iio
import jax.numpy as jnp
import numpy as np
import pytest
from follower import WORLDS, Follower, alone, point_world
from rich.console import Console

from milx.data.dataset import Writer
from milx.evaluation.intervals import wilson_interval
from milx.types import Demo, Spec
from milx.worlds import report, worker
from milx.worlds.actor import CONTROLS
from milx.worlds.client import Client, WorldError
from milx.worlds.evaluate import evaluate_in
from milx.worlds.slot import Episode, Outcome, Task


class Wide(Follower):
    """Has an action too many."""

    def act(self, task_params, observation, memory):
        return jnp.zeros(3), memory


class Watcher(Follower):
    """Does as much as the brightness of the left and of the right half of its picture says."""

    def act(self, task_params, observation, memory):
        left, right = observation.image[:, :15].mean(), observation.image[:, 15:].mean()
        return jnp.stack([left, right]) / 1000 - 0.1, memory


@pytest.fixture(autouse=True)
def folder(monkeypatch):
    monkeypatch.chdir(WORLDS)


TASKS = [Task(name, name.partition("/")[0]) for name in point_world.GOALS]


def test_episodes_end_as_they_do_one_after_the_other(policy):
    """Runs all controls in three worlds at once; every outcome is that of a loop in this process."""
    outcomes = evaluate_in(policy, "point_world:make", TASKS, episodes=3, seed=100, workers=3)
    assert len(outcomes) == len(TASKS) * len(CONTROLS) * 3
    shown = [task._replace(demos=(Demo(),)) for task in TASKS]
    for outcome in outcomes:
        assert outcome.lost is None
        assert outcome.steps == point_world.LENGTH
        assert (outcome.ever, outcome.end) == alone(shown, outcome.episode, demo_seed=99), outcome.episode
    rate = {name: np.mean([o.end for o in outcomes if o.episode.control == name]) for name in CONTROLS}
    assert rate["own"] == 1
    assert rate["replay"] > rate["other_family"] == rate["same_family"] == rate["unadapted"] == 0


def test_no_episode_starts_where_a_recorded_demonstration_did(policy):
    """Compares with the starts of as many demonstrations as `milx.worlds.record` could make in vain and not."""
    outcomes = evaluate_in(policy, "point_world:make", TASKS[:1], controls=["mean_action"], episodes=5)
    world = point_world.PointWorld(TASKS[0].name)
    starts = np.stack([world.reset(seed=outcome.episode.seed)[0] for outcome in outcomes])
    recorded = np.stack([world.demonstrate(seed)["state"][0] for seed in range(50)])
    assert np.linalg.norm(starts[:, None] - recorded[None], axis=-1).min() > 1e-6


@pytest.mark.slow
def test_worlds_that_fail_cost_their_episodes_and_are_reported(policy):
    began = time.monotonic()
    demo = Demo(state=np.ones((6, 2)), action=np.zeros((6, 2)))
    outcomes = evaluate_in(
        policy,
        "point_world:make_frail",
        [Task("near/right", "near", (demo,))],
        controls=["own"],
        episodes=6,
        seed=0,
        workers=2,
        timeout=3.0,
    )
    assert time.monotonic() - began < 30
    lost = [outcome.lost for outcome in outcomes]
    assert [not reason and outcome.end for reason, outcome in zip(lost, outcomes, strict=True)] == [
        True,
        False,
        False,
        False,
        True,
        True,
    ]
    assert "has ended (exit code 7)" in lost[1]
    assert "has not answered within 3 s" in lost[2]
    assert "ZeroDivisionError: the world's own error" in lost[3]


def test_a_state_that_is_not_finite_costs_its_episode(policy):
    demo = Demo(state=np.ones((6, 2)), action=np.zeros((6, 2)))
    outcomes = evaluate_in(
        policy,
        "point_world:make_diverging",
        [Task("near/right", "", (demo,))],
        controls=["own", "own"],
        episodes=4,
        workers=2,
    )
    assert [outcome.end for outcome in outcomes] == [False, True, False, True]
    assert [outcome.steps for outcome in outcomes] == [2, point_world.LENGTH] * 2
    assert re.fullmatch(r"the state is \[nan nan\], expected finite numbers", outcomes[0].lost)


@pytest.mark.slow
def test_a_world_that_loses_every_episode_ends_the_evaluation(policy):
    demo = Demo(state=np.ones((6, 2)), action=np.zeros((6, 2)))
    tasks = [Task("near/right", "", (demo,))]
    with pytest.raises(WorldError, match=r"(?s)all of the first 1\d episodes were lost: .*neither is_success"):
        evaluate_in(policy, "point_world:make_pictured", tasks, controls=["own"], episodes=12, workers=2)
    wide = dataclasses.replace(policy, method=Wide())
    with pytest.raises(WorldError, match=r"action: got \[3\], expected actions of Box\(.*\), a box of the same shape"):
        evaluate_in(wide, "point_world:make", tasks, controls=["own"], episodes=12, workers=2)


@pytest.mark.slow
def test_nothing_is_left_of_a_world_when_the_process_that_evaluates_is_told_to_stop(tmp_path):
    """Sends SIGTERM while a world hangs that has started a process: both have ended soon after."""
    program = """
    import numpy as np
    from milx.core.commands import command
    from milx.worlds.client import Client
    with command():
        client = Client("point_world:make_parent", __import__("sys").executable, 600.0)
        client.ask({"do": "reset", "task": "near/left", "seed": 0})
        client.ask({"do": "step"}, action=np.zeros(2))
    """
    said = tmp_path / "children"
    environment = {**os.environ, "POINT_WORLD_CHILDREN": str(said)}
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(program)], env=environment)
    try:
        wait_for(lambda: said.is_file() and len(said.read_text().split()) == 2)
        process.terminate()
        assert process.wait(10) == 143
        wait_for(lambda: not any(pathlib.Path(f"/proc/{number}/exe").exists() for number in said.read_text().split()))
    finally:
        process.kill()


def wait_for(condition):
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_worlds_that_cannot_be_started_say_why(policy):
    for make, message in (
        ("no_such_module:make", "No module named 'no_such_module'"),
        ("point_world:no_such_function", "has no attribute 'no_such_function'"),
    ):
        with pytest.raises(WorldError, match=message):
            evaluate_in(policy, make, TASKS, workers=1)
    with pytest.raises(WorldError, match="python: no_such_python cannot be run: No such file"):
        evaluate_in(policy, "point_world:make", TASKS, workers=1, python="no_such_python")
    with pytest.raises(ValueError, match="controls: got 'expert', expected some of own"):
        evaluate_in(policy, "point_world:make", TASKS, controls=["expert"])


def test_larger_pictures_are_shrunk_and_other_ones_refused(policy):
    """Acts by what is seen: the episode is that of a loop which computes the brightness of the whole picture."""
    spec = dataclasses.replace(policy.spec, image_shape=(20, 30))
    demo = Demo(np.zeros((6, 20, 30, 3), np.uint8), np.zeros((6, 2)), np.zeros((6, 2)))
    tasks = [Task("near/left", "near", (demo,))]
    seeing = dataclasses.replace(policy, spec=spec, method=Watcher())
    (outcome,) = evaluate_in(
        seeing, "point_world:make_pictured_well", tasks, controls=["own"], episodes=1, seed=0, workers=1, film=1
    )
    world = point_world.Pictured("near/left")
    picture = world.reset(seed=0)[0]["pixels"]
    for seen in outcome.images[:-1]:
        np.testing.assert_array_equal(seen[:, [0, -1]], picture[::2][:, [0, -1]])
        action = np.array([picture[:, :30].mean(), picture[:, 30:].mean()]) / 1000 - 0.1
        picture = world.step(action.astype(np.float32))[0]["pixels"]
    assert len(outcome.images) == point_world.LENGTH + 1
    assert len(np.unique(np.stack(outcome.images))) > 5
    other = dataclasses.replace(policy, spec=dataclasses.replace(spec, image_shape=(20, 20)))
    square = [Task("near/left", "near", (dataclasses.replace(demo, image=demo.image[:, :, :20]),))]
    with pytest.raises(ValueError, match=r"observation.image: got shape \[40, 60, 3\], expected \[20, 20, 3\]"):
        evaluate_in(other, "point_world:make_pictured", square, controls=["random"], episodes=1, workers=1)


def test_worlds_without_an_episode_do_not_disturb_a_policy_that_sees_images_alone(policy):
    """Runs one episode in one of three worlds, of which two have nothing to do, and in the only one."""
    image = np.random.default_rng(0).integers(0, 256, (9, 20, 30, 3), np.uint8)
    tasks = [Task("near/left", "near", (Demo(image, None, np.zeros((9, 2))),))]
    seeing = dataclasses.replace(policy, spec=Spec((20, 30), 0, 2, None, ()), method=Watcher())
    one, of_three = (
        evaluate_in(
            seeing,
            "point_world:make_pictured_well",
            tasks,
            controls=["own"],
            episodes=1,
            seed=0,
            workers=workers,
            film=1,
        )[0].images
        for workers in (1, 3)
    )
    np.testing.assert_array_equal(one, of_three)
    assert len(np.unique(np.stack(one))) > 5


def test_anybody_can_speak_the_protocol():
    """Asks the world's process itself, as a policy of somebody else's would."""
    client = Client("point_world:make_pictured", sys.executable, 60)
    _, seen = client.ask({"do": "reset", "task": "near/left", "seed": 5})
    world = point_world.Pictured("near/left")
    expected, _ = world.reset(seed=5)
    np.testing.assert_array_equal(seen["state"], expected["agent_pos"])
    np.testing.assert_array_equal(seen["image"], expected["pixels"])
    assert seen["state"].dtype == np.float64
    with pytest.raises(WorldError, match="do: got 'dance', expected reset, step, demonstrate or tasks"):
        client.ask({"do": "dance"})


def test_a_run_is_evaluated_in_the_world_whose_tasks_its_data_set_names(policy, monkeypatch, tmp_path):
    """Holds out two tasks of a data set; the report says of each control how often it succeeded."""
    with Writer(tmp_path / "set", None, 2, 2, "a test") as writer:
        for name, split in zip(point_world.GOALS, ("train", "validation", "test", "test"), strict=True):
            shown = point_world.PointWorld(name).demonstrate(7)
            writer.add(name, split, [point_world.LENGTH], [Demo(**shown)])
    policy.config.recorded.path = str(tmp_path / "set")
    monkeypatch.setattr(report, "load_run", lambda folder: policy)
    console = Console(file=io.StringIO(), width=200)
    report.report_on(policy.config, tmp_path, "point_world:make", console, episodes=4, workers=2)
    found = json.loads((tmp_path / "gym.json").read_text())
    assert found["tasks"] == ["far/left", "far/right"]
    assert set(found["controls"]) == set(CONTROLS) - {"other_family"}
    own = found["controls"]["own"]
    assert (own["episodes"], own["lost"], own["ever"], own["end"]) == (8, 0, 1.0, 1.0)
    assert own["end_wilson95"] == pytest.approx(wilson_interval(8, 8))
    assert found["controls"]["same_family"]["ever"] == 0
    assert re.search(r"its own demonstration.* 100.0% \(68 to 100\)", console.file.getvalue())
    assert found["data"] == str(tmp_path / "set")


def test_a_run_is_evaluated_on_all_tasks_of_another_data_set(policy, monkeypatch, tmp_path, capsys):
    """The other one has tasks of all splits, one of them without actions. The run's own one does not exist."""
    with Writer(tmp_path / "later", None, 2, 2, "a test") as writer:
        for name, split in (("near/left", "train"), ("far/right", "validation"), ("near/right", "test")):
            shown = point_world.PointWorld(name).demonstrate(7)
            writer.add(name, split, [point_world.LENGTH], [Demo(**shown)])
        writer.add("far/left", "test", [point_world.LENGTH], [Demo(None, shown["state"])])
    policy.config.recorded.path = str(tmp_path / "missing")
    monkeypatch.setattr(report, "load_run", lambda folder: policy)
    options = {"episodes": 3, "workers": 2, "data": str(tmp_path / "later")}
    report.report_on(policy.config, tmp_path, "point_world:make", Console(file=io.StringIO()), **options)
    found = json.loads((tmp_path / "gym-later.json").read_text())
    assert "data: 1 of the 4 tasks of" in capsys.readouterr().err
    assert (found["data"], found["tasks"]) == (options["data"], ["near/left", "far/right", "near/right"])
    assert {name: found["controls"][name]["end"] for name in ("own", "same_family")} == {"own": 1.0, "same_family": 0.0}


def test_a_task_of_another_data_set_that_does_not_fit_is_named(policy, monkeypatch, tmp_path):
    with Writer(tmp_path / "later", None, 3, 2, "a test") as writer:
        writer.add("near/left", "test", [4], [Demo(None, np.zeros((4, 3), np.float32), np.zeros((4, 2), np.float32))])
    policy.config.recorded.path = str(tmp_path / "missing")
    monkeypatch.setattr(report, "load_run", lambda folder: policy)
    with pytest.raises(ValueError, match=r"data: .*later, task near/left: demo\.state: got .*, expected"):
        report.report_on(
            policy.config, tmp_path, "point_world:make", Console(file=io.StringIO()), data=str(tmp_path / "later")
        )


def test_the_video_shows_the_demonstration_beside_the_trial(policy, monkeypatch, tmp_path):
    """Colors every image by its time step; the shorter one of the two keeps its last image."""

    def gray(steps, first):
        return [np.full((6, 10, 3), first + 20 * step, np.uint8) for step in range(steps)]

    tasks = [Task("a", demos=(Demo(np.stack(gray(4, 10))),)), Task("b", demos=(Demo(np.stack(gray(2, 15))),))]
    outcomes = [
        Outcome(Episode("own", 0, 0), images=gray(2, 130)),
        Outcome(Episode("own", 1, 0), images=gray(3, 135)),
        Outcome(Episode("own", 1, 1)),
    ]
    seeing = dataclasses.replace(policy, spec=Spec((6, 10), 2, 2, None, ()))
    for name, value in (("load_run", seeing), ("DataSet", None), ("tasks_of", tasks), ("evaluate_in", outcomes)):
        monkeypatch.setattr(report, name, lambda *_, value=value, **__: value)
    policy.config.recorded.path = "somewhere"
    report.report_on(policy.config, tmp_path, "point_world:make", Console(file=io.StringIO()))
    frames = iio.imread(tmp_path / report.VIDEO).astype(int)
    left, gap, right = frames[:, 3, 5, 0], frames[:, 3, 14, 0], frames[:, 3, 23, 0]
    expected = np.array([(10, 130), (30, 150), (50, 150), (70, 150), (15, 135), (35, 155), (35, 175)])
    changes = np.flatnonzero(np.diff(left) | np.diff(right)) + 1  # the last image of a task stays
    np.testing.assert_allclose(np.stack([left, right], axis=1)[np.append(0, changes)], expected, atol=2)
    assert (gap > 250).all()


def test_images_of_several_cameras_are_named_and_other_dictionaries_refused():
    """Asks the process that runs a world what it makes of observations."""
    image = np.zeros((4, 4, 3), np.uint8)
    seen = worker._seen({"pixels": {"hand": image, "scene": image + 1}, "agent_pos": [1.0, 2.0]})
    assert sorted(seen) == ["image.hand", "image.scene", "state"]
    assert seen["image.scene"].max() == 1
    assert sorted(worker._seen({"pixels": {"hand": image}})) == ["image"]
    for observation, message in (
        ({"agent_pos": {"a": [0.0], "b": [1.0]}}, r"state: has \['a', 'b'\], expected an array"),
        ({"pixels": {}}, r"image: has \[\], expected an array, or images of several cameras by name"),
    ):
        with pytest.raises(ValueError, match=message):
            worker._seen(observation)
