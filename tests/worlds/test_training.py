"""A run on recorded demonstrations whose checkpoints are chosen by their success in a world."""

import io

import numpy as np
import pytest
from follower import WORLDS, interpreter, point_world
from rich.console import Console
from tiny import QUIET

import milx
from milx.core.checkpoint import UNVALIDATED, Checkpoints
from milx.data.dataset import Writer
from milx.training import recorded
from milx.training.factory import make_run
from milx.training.metrics import read_metrics
from milx.types import Demo
from milx.worlds import WorldError, evaluate_in, tasks_of

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


def test_a_validation_without_a_finished_episode_has_no_score_and_does_not_end_training(config, tmp_path):
    """Lets no world start after the one that is tried before training, then any: the last checkpoint is validated."""
    config.train.steps, folder = 400, tmp_path / "run"
    once = f"mkdir {tmp_path}/taken || exit 7"
    config.evaluation.gym_python = interpreter(tmp_path / "python", once)
    console = Console(file=io.StringIO(), width=1000)
    make_run(config, folder, console).train()
    lines = read_metrics(folder / "metrics.jsonl")
    assert [line["step"] for line in lines if "validation_score" in line] == [200, 400]
    assert not any("validation_success" in line for line in lines)
    checkpoints = Checkpoints(folder / "checkpoints", read_only=True)
    assert checkpoints.latest == 400
    assert checkpoints.score(400) == UNVALIDATED
    said = console.file.getvalue()
    reason = "the world could not be started in 3 attempts: point_world:make: has ended (exit code 7)"
    assert said.count(f"milx: the validation in point_world:make failed: {reason}") == 2
    assert "step 400: validation success unknown" in said
    config.evaluation.gym_python = None
    make_run(config, folder, QUIET).train()
    (line,) = (line for line in read_metrics(folder / "metrics.jsonl") if "validation_success" in line)
    assert line["step"] == 400
    assert Checkpoints(folder / "checkpoints", read_only=True).score(400) == line["validation_success"] > 0


def test_a_validation_that_loses_all_of_a_few_episodes_has_no_score(config, tmp_path):
    """Acts in a world that does not tell success: there are too few episodes for that to be an error of its own."""
    config.train.steps, config.evaluation.gym = 200, "point_world:make_pictured"
    console = Console(file=io.StringIO(), width=1000)
    make_run(config, tmp_path / "run", console).train()
    assert Checkpoints(tmp_path / "run" / "checkpoints", read_only=True).score(200) == UNVALIDATED
    said = console.file.getvalue()
    assert "an episode was lost: point_world:make_pictured: " in said and "neither is_success nor success" in said
    assert "step 200: validation success unknown" in said


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
