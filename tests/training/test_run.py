"""A run's folder: what is in it, and that an interrupted run ends like one that was never interrupted."""

import copy
import dataclasses
import json
import re
import threading
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
import pytest
from tiny import QUIET, tiny_config

import milx
from milx import methods
from milx.config import assemble
from milx.core import pytrees
from milx.core.checkpoint import Checkpoints
from milx.methods import params_like
from milx.networks import fixed_filters
from milx.training.metrics import MetricsWriter
from milx.training.simulated import SimulatedRun, training_on
from milx.training.state import initial_state

RESULT_FIELDS = {
    *("env", "method", "preset", "variant", "seed", "num_tasks_train", "num_demos_train", "shots", "given"),
    *("env_version", "trials", "success", "wilson95", "criterion", "baselines", "wall_clock_s", "steps", "config"),
    *("dataset_hash", "commit", "hardware", "versions"),
}


def final_items(run):
    """Restores parameters and optimizer of the newest checkpoint, and its step."""
    checkpoints = Checkpoints(run.folder / "checkpoints", read_only=True)
    params = params_like(run.method, run.env.spec)
    step = jax.ShapeDtypeStruct((), np.int32)
    like = {"params": params, "trainer": (step, jax.eval_shape(run.trainer.optimizer.init, params))}
    items, _ = checkpoints.restore(checkpoints.latest, like)
    return items, checkpoints.latest


def untimed(lines):
    """Leaves out the metric that a clock measures."""
    return [{name: value for name, value in line.items() if name != "steps_per_s"} for line in lines]


class StoppedError(Exception):
    pass


def same_run(trained, folder):
    """Makes a new run of the same configuration; it borrows the compiled programs."""
    run = SimulatedRun(tiny_config(), folder, QUIET)
    run.env, run.method, run.trainer = trained.run.env, trained.run.method, trained.run.trainer
    return run


@pytest.mark.slow
def test_interrupted_run_ends_bit_for_bit_like_the_uninterrupted_one(trained, tmp_path, monkeypatch):
    write = MetricsWriter.write

    def interrupt(self, step, values):
        if step == 4 and "validation_success" in values:
            raise StoppedError
        write(self, step, values)

    with monkeypatch.context() as patch:
        patch.setattr(MetricsWriter, "write", interrupt)
        with pytest.raises(StoppedError):
            same_run(trained, tmp_path).train()
    # The checkpoint of step 4 is there, without its score, and the loss of step 4 is already in the file.
    assert Checkpoints(tmp_path / "checkpoints", read_only=True).latest == 4
    assert [json.loads(line)["step"] for line in (tmp_path / "metrics.jsonl").open()] == [2, 2, 4]

    written = []
    monkeypatch.setattr(
        MetricsWriter, "write", lambda self, step, values: (written.append(step), write(self, step, values))
    )
    resumed = same_run(trained, tmp_path)
    resumed.train()
    assert written == [4, 6, 6], "it continues from the checkpoint, which it validates first"

    (expected, last), (found, found_last) = final_items(trained.run), final_items(resumed)
    assert found_last == last == 6
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for (path, a), b in zip(jax.tree.leaves_with_path(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b, err_msg=jax.tree_util.keystr(path))
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").open()]
    assert untimed(lines) == untimed(trained.metrics)


def test_training_changes_the_parameters_but_not_the_whitening(trained):
    items, _ = final_items(trained.run)
    init_key, _ = jax.random.split(jax.random.fold_in(jax.random.key(trained.config.seed), 3))
    start = jax.jit(trained.run.method.init)(init_key, items["params"]["whitening"])
    moved = jax.tree.map(lambda a, b: float(np.abs(a - b).max()), items["params"]["policy"], start["policy"])
    # Adam moves every entry with a gradient by about the learning rate of a step; there are six steps.
    peak = trained.config.optimizer.learning_rate
    assert 0.1 * peak < max(jax.tree.leaves(moved)) < 6 * peak
    seen = jax.jit(jax.vmap(jax.vmap(jax.vmap(trained.run.env.robot_state))))(trained.train.states)
    mean = np.asarray(seen, np.float64).mean(axis=(0, 1, 2))
    np.testing.assert_allclose(items["params"]["whitening"].state_mean, mean, atol=1e-5)


@pytest.mark.slow
def test_a_fixed_first_layer_is_made_from_what_the_training_demonstrations_show_first(trained):
    config = tiny_config()
    config.network.fixed_filters = "kmeans"
    trainer = dataclasses.replace(trained.run.trainer, method=methods.make(config, trained.run.env.spec))
    state, _ = initial_state(trainer, config, training_on(trained.run.env, config, trained.train))
    first = jax.tree.map(lambda x: x[:, 0, 0], trained.train.states)
    images = jax.jit(jax.vmap(trained.run.env.render))(trained.train.task, first)
    expected = fixed_filters.cluster([np.asarray(images)], config.network)
    layer = state.params["policy"]["vision"]["ConvBlock_0"]
    np.testing.assert_array_equal(layer["fixed_kernel"], expected.kernel)
    assert np.abs(expected.kernel).max() > 0.1


@pytest.mark.parametrize(
    ("group", "field", "value"),
    [("train", "meta_batch", 3), ("network", "filters", (4, 5)), ("data", "noise", 0.5), (None, "seed", 7)],
)
def test_folder_of_another_configuration_is_refused(trained, group, field, value):
    config = copy.deepcopy(trained.config)
    holder = getattr(config, group) if group else config
    before = getattr(holder, field)
    setattr(holder, field, value)
    name = f"{group}.{field}" if group else field
    kept = (trained.folder / "config.json").read_text()
    with pytest.raises(ValueError, match=re.escape(f"{name} was {before}, now {value}")) as error:
        SimulatedRun(config, trained.folder, QUIET)
    assert str(trained.folder) in str(error.value)
    assert str(error.value).count(" was ") == 1
    assert (trained.folder / "config.json").read_text() == kept


def test_run_without_a_checkpoint_cannot_be_evaluated(tmp_path):
    with pytest.raises(ValueError, match="no checkpoint yet"):
        SimulatedRun(tiny_config(), tmp_path, QUIET).evaluate()


def test_metrics_hold_a_loss_and_a_validation_at_every_interval(trained):
    config = trained.config.train
    losses = {line["step"]: line["loss"] for line in trained.metrics if "loss" in line}
    valid = {line["step"]: line["validation_success"] for line in trained.metrics if "validation_success" in line}
    assert list(losses) == list(range(config.log_every, config.steps + 1, config.log_every))
    assert list(valid) == list(range(config.eval_every, config.steps + 1, config.eval_every))
    assert np.isfinite(list(losses.values())).all()
    trials = trained.config.evaluation.validation_tasks * trained.config.evaluation.trials
    for success in valid.values():
        assert success * trials == pytest.approx(round(success * trials), abs=1e-5)


@pytest.mark.slow
def test_best_checkpoint_has_the_highest_validation_success(trained, tmp_path, monkeypatch):
    successes = iter([0.25, 0.75, 0.5])
    monkeypatch.setattr(SimulatedRun, "_validate", lambda *_: (next(successes), {}))
    monkeypatch.setattr(SimulatedRun, "_precompile", lambda *_: [])  # nothing is evaluated
    run = same_run(trained, tmp_path)
    run.train()
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").open()]
    valid = {line["step"]: line["validation_success"] for line in lines if "validation_success" in line}
    assert valid == {2: 0.25, 4: 0.75, 6: 0.5}
    assert Checkpoints(tmp_path / "checkpoints", read_only=True).best == 4

    policy = milx.load(tmp_path)
    latest, _ = final_items(run)
    apart = jax.tree.map(lambda a, b: np.abs(a - b).max(), policy.params["policy"], latest["params"]["policy"])
    assert max(jax.tree.leaves(apart)) > 1e-5, "the best is loaded, not the latest"


def test_best_and_latest_checkpoints_are_kept(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    for step, success in enumerate((0.1, 0.9, 0.3, 0.2, 0.4)):
        checkpoints.save(step, {"params": {"w": np.full(3, step, np.float32)}}, success, {"seconds": step})
    checkpoints.close()
    reader = Checkpoints(tmp_path, read_only=True)
    assert (reader.best, reader.latest) == (1, 4)
    assert sorted(int(path.name) for path in tmp_path.iterdir() if path.name.isdigit()) == [1, 3, 4]
    items, extra = reader.restore(1, {"params": {"w": jax.ShapeDtypeStruct((3,), np.float32)}})
    np.testing.assert_array_equal(items["params"]["w"], 1)
    assert extra == {"seconds": 1}


def test_evaluation_is_a_result_file(trained):
    result = json.loads((trained.folder / "evaluation.json").read_text())
    assert result == json.loads(json.dumps(trained.result))
    assert set(result) >= RESULT_FIELDS
    assert (result["env"], result["method"], result["preset"], result["seed"]) == ("reach", "mil", "cpu", 0)
    assert (result["num_tasks_train"], result["num_demos_train"], result["trials"]) == (8, 24, 6)
    for split in ("train", "validation", "test"):
        success = getattr(trained, split).success
        assert result["demonstrations"][split] == {"count": success.size, "success": pytest.approx(success.mean())}
    low, high = result["wilson95"]
    assert 0 <= low <= result["success"] <= high <= 1
    assert high - low > 0.3, "six trials tell little"
    assert assemble.from_dict(result["config"]) == trained.config
    assert result["dataset_hash"] == pytrees.fingerprint(trained.train)
    assert set(result["baselines"]) == {"random", "task_blind", "expert", "other_demo"}
    for rate in (result["success"], *result["baselines"].values()):
        assert rate * 6 == pytest.approx(round(rate * 6), abs=1e-5)
    clock = result["wall_clock_s"]
    assert set(clock) == {"demos", "compile", "train", "evaluate", "total"}
    parts = sum(seconds for name, seconds in clock.items() if name != "total")
    assert 0.5 * clock["total"] < parts <= clock["total"] * 1.001


@pytest.mark.parametrize("captures", [False, True])
def test_all_is_compiled_before_graphs_are_captured(captures, tmp_path, monkeypatch):
    loading, compiled = threading.Event(), []

    def compile_in_background(*_):
        """Compiles until the demonstrations are loaded, which must not begin before where graphs are captured."""
        compiled.append(thread.submit(loading.wait, 0.2 if captures else 10.0))
        return compiled

    def load(self):
        loading.set()
        raise StoppedError

    monkeypatch.setattr("milx.training.run.compile_in_background", compile_in_background)
    monkeypatch.setattr(SimulatedRun, "_load", load)
    run = SimulatedRun(tiny_config(), tmp_path, QUIET)
    monkeypatch.setattr(type(run.env), "captures_graphs", captures)
    with ThreadPoolExecutor(max_workers=1) as thread, pytest.raises(StoppedError):
        run.train()
    assert compiled[0].result() is not captures, "whether loading began while programs were compiled"
