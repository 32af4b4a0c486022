"""A run on recorded demonstrations whose checkpoints are chosen by their success in a world."""

import pathlib
import sys

import numpy as np
import pytest

import milx
from milx.core.checkpoint import Checkpoints
from milx.data.dataset import Writer
from milx.training import recorded
from milx.training.factory import make_run
from milx.training.metrics import read_metrics
from milx.types import Demo
from milx.worlds import WorldError, evaluate_in, tasks_of

WORLDS = pathlib.Path(__file__).parents[1] / "fixtures" / "worlds"
sys.path.insert(0, str(WORLDS))
import point_world  # noqa: E402
from tiny import QUIET  # noqa: E402

pytestmark = pytest.mark.slow


@pytest.fixture
def config(tmp_path, monkeypatch):
    """Configures a short run on 40 places to go to, of which the corners are held out."""
    monkeypatch.chdir(WORLDS)
    rng = np.random.default_rng(0)
    names = [f"anywhere/{x:.2f},{y:.2f}" for x, y in rng.uniform(-2, 2, (40, 2))]
    with Writer(tmp_path / "set", None, 2, 2, "a test") as writer:
        for name in (*names, *point_world.GOALS):
            split = "train" if name in names else "validation" if name.endswith("left") else "test"
            demos = [Demo(**point_world.PointWorld(name).demonstrate(seed)) for seed in range(3)]
            writer.add(name, split, [point_world.LENGTH] * 3, demos, name.split("/")[0])
    config = recorded.config_for(tmp_path / "set", preset="cpu")
    config.recorded.horizon, config.network.fc_layers = point_world.LENGTH, (60, 60)
    config.train.steps, config.train.log_every, config.train.eval_every = 600, 100, 200
    config.train.meta_batch = 8
    config.evaluation.gym, config.evaluation.gym_workers, config.evaluation.trials = "point_world:make", 2, 3
    return config


def test_checkpoints_are_chosen_by_success_in_the_world(config, tmp_path):
    """Evaluates the best checkpoint again: its success is its score, and no validation has a higher one."""
    run = make_run(config, tmp_path / "run", QUIET)
    run.train()
    lines = read_metrics(tmp_path / "run" / "metrics.jsonl")
    successes = [line["validation_success"] for line in lines if "validation_success" in line]
    assert len(successes) == 3
    checkpoints = Checkpoints(tmp_path / "run" / "checkpoints", read_only=True)
    score = checkpoints.score(checkpoints.best)
    policy = milx.load(tmp_path / "run")
    tasks = tasks_of(run.data, "validation", policy)
    assert [task.name for task in tasks] == ["near/left", "far/left"]
    outcomes = evaluate_in(policy, "point_world:make", tasks, controls=["own"], episodes=3, workers=3)
    assert np.mean([outcome.ever for outcome in outcomes]) == score == max(successes)
    assert score > 0
    assert run.evaluate()["score"] > 0


def test_a_world_that_cannot_be_started_ends_the_run_before_training(config, tmp_path):
    config.evaluation.gym = "point_world:no_such_function"
    run = make_run(config, tmp_path / "run", QUIET)
    with pytest.raises(WorldError, match="has no attribute 'no_such_function'"):
        run.train()
    assert not (tmp_path / "run" / "metrics.jsonl").exists()


def test_a_policy_with_a_history_is_chosen_in_the_world_extended_and_started_from(config, tmp_path):
    """Trains in two parts, evaluates the best checkpoint again, and begins another run with its parameters."""
    config.recorded.history, config.train.steps, folder = 2, 200, tmp_path / "run"
    make_run(config, folder, QUIET).train()
    before = read_metrics(folder / "metrics.jsonl")
    config.train.steps = 400
    run = make_run(config, folder, QUIET)
    run.train()
    lines = read_metrics(folder / "metrics.jsonl")
    assert lines[: len(before)] == before
    assert [line["step"] for line in lines if "validation_success" in line] == [200, 400]
    policy = milx.load(folder)
    tasks = tasks_of(run.data, "validation", policy)
    outcomes = evaluate_in(policy, "point_world:make", tasks, controls=["own"], episodes=3, workers=3)
    checkpoints = Checkpoints(folder / "checkpoints", read_only=True)
    assert np.mean([outcome.ever for outcome in outcomes]) == checkpoints.score(checkpoints.best) > 0
    config.train.init, config.train.steps, config.seed = str(folder), 200, 1
    make_run(config, tmp_path / "next", QUIET).train()
    first, after = (
        next(line["loss"] for line in found if "loss" in line)
        for found in (before, read_metrics(tmp_path / "next" / "metrics.jsonl"))
    )
    assert after < first, "what was learned must be there after the first 100 updates"
