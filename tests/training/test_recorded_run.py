"""A run on recorded demonstrations, from importing to a policy: the demonstrations are of tasks with a known answer."""

import contextlib
import dataclasses
import io
import json
import shutil
import signal

import jax
import numpy as np
import pytest
from directions import HORIZON, random_demo, tiny_config, write_directions, write_tasks
from rich.console import Console
from tiny import QUIET

import milx
from milx import methods
from milx.config import assemble
from milx.core import pytrees, signals
from milx.core.checkpoint import UNVALIDATED, Checkpoints
from milx.data.dataset import DataSet, Writer
from milx.deploy import standalone
from milx.deploy.policy import read_spec
from milx.export import export
from milx.methods.whitening import Whitening
from milx.training import recorded
from milx.training.factory import make_run
from milx.training.metrics import MetricsWriter, read_metrics
from milx.training.recorded import RecordedRun
from milx.training.start import start_from


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_directions(tmp_path_factory.mktemp("recording") / "set")


@pytest.fixture(scope="module")
def finished(cache, folder, tmp_path_factory):
    run = make_run(tiny_config(folder), tmp_path_factory.mktemp("run"), QUIET)
    run.train()
    return run, run.evaluate()


def test_held_out_tasks_are_learned_from_their_demonstration(finished):
    """Compares with the direction's share of the actions' variance, 1.5^2/2 of 1.5^2/2 + 0.5^2: it is the task."""
    run, result = finished
    errors = result["action_error"]
    assert errors["tasks"] == 6
    assert errors["mean_action"] == pytest.approx(1, abs=0.25)
    assert errors["after"] < 0.4 * errors["before"]
    assert errors["other_task"] > errors["mean_action"]
    assert result["score"] == pytest.approx(1 - errors["after"] / errors["mean_action"])
    assert "network.filters=(4, 4)" in result["variant"]
    assert "recorded.path" not in result["variant"]
    lines = [json.loads(line) for line in (run.folder / "metrics.jsonl").open()]
    scores = [line["validation_score"] for line in lines if "validation_score" in line]
    assert len(scores) == 3
    assert max(scores) > 0.5
    assert (run.folder / "learning_curve.png").stat().st_size > 1000


def read_resampled(data, task):
    steps = [np.linspace(0, length - 1, HORIZON).round().astype(int) for length in data.header.tasks[task].lengths]
    return [data.read(task, i, index) for i, index in enumerate(steps)]


def test_a_run_starts_from_the_parameters_of_another_as_far_as_they_fit(finished, folder):
    """Starts a policy with one more layer: its own last layers have other sizes, and the whitening is its own."""
    run, config = finished[0], tiny_config(folder)
    config.network.fc_layers = (40, 40, 30)
    method = methods.make(config, run.spec)
    ones = Whitening(np.zeros(3), np.ones(3), np.zeros(2), np.ones(2))
    drawn, theirs = method.init(jax.random.key(5), ones), milx.load(run.folder).params
    started = pytrees.leaves(start_from(str(run.folder), drawn, config))
    for name, value in pytrees.leaves(drawn).items():
        other = pytrees.leaves(theirs).get(name)
        fits = other is not None and other.shape == value.shape and not name.startswith("whitening")
        np.testing.assert_array_equal(started[name], other if fits else value)
    kernel = "policy.controller.Dense_{}.kernel"
    assert (started[kernel.format(1)] != pytrees.leaves(drawn)[kernel.format(1)]).all()
    assert (started[kernel.format(2)] == pytrees.leaves(drawn)[kernel.format(2)]).all()
    with pytest.raises(ValueError, match=r"init: got .*, none of whose kernels fits here, .* has no other"):
        start_from(str(run.folder), {"other": np.zeros(3)}, config)
    config.train.init = "nowhere"
    with pytest.raises(ValueError, match="run: got 'nowhere', expected the folder of a run, or one of"):
        make_run(config, run.folder.parent / "init", QUIET)


@pytest.mark.slow
def test_a_run_goes_on_when_the_one_it_started_from_is_gone(finished, folder, tmp_path):
    """Moves the other run away; what has been learned since then is all in the checkpoint."""
    config, other = tiny_config(folder), shutil.copytree(finished[0].folder, tmp_path / "other")
    config.train.init, config.train.steps, config.train.eval_every = str(other), 50, 50
    make_run(config, tmp_path / "run", QUIET).train()
    other.rename(tmp_path / "moved")
    config.train.steps = 100
    make_run(config, tmp_path / "run", QUIET).train()
    assert read_metrics(tmp_path / "run" / "metrics.jsonl")[-1]["step"] == 100


@pytest.mark.slow
def test_a_run_can_be_extended_and_not_shortened(finished, folder, tmp_path):
    """Goes on to 400 updates: the lines before stay as they are, and the folder is that of the longer run."""
    copy = shutil.copytree(finished[0].folder, tmp_path / "run")
    before = read_metrics(copy / "metrics.jsonl")
    config = tiny_config(folder)
    config.train.steps, config.evaluation.gym_workers = 400, 9
    make_run(config, copy, QUIET).train()
    lines = read_metrics(copy / "metrics.jsonl")
    assert lines[: len(before)] == before
    assert sorted({line["step"] for line in lines[len(before) :]}) == [350, 400]
    assert json.loads((copy / "config.json").read_text())["train"]["steps"] == 400
    with pytest.raises(ValueError, match=r"holds another run: train.steps was 400, now 300"):
        make_run(tiny_config(folder), copy, QUIET)
    assert Checkpoints(copy / "checkpoints", read_only=True).latest == 400


def test_a_run_goes_on_where_only_what_it_does_not_read_has_changed(finished, folder):
    """Presets may change simulated worlds and their experts, which say nothing of recorded demonstrations."""
    config = tiny_config(folder)
    config.data.expert, config.data.plan_iterations, config.env.goal_step = "controller", 0, 7
    make_run(config, finished[0].folder, QUIET)
    config.method.inner_lr /= 2
    with pytest.raises(ValueError, match=r"holds another run: method.inner_lr was 0.03, now 0.015$"):
        make_run(config, finished[0].folder, QUIET)


def test_errors_are_those_of_a_loop_over_demonstrations(finished, folder):
    """Compares what the run reports with what the policy that users load does, step by step."""
    run, result = finished
    policy, data = milx.load(run.folder), DataSet(folder)
    training = recorded.read_vectors(data, data.header.of_split("train"), HORIZON).action
    errors = []
    for task in data.header.of_split("test"):
        demos = read_resampled(data, task)
        task_params = policy.adapt(policy.params, demos[0])
        for query in demos[1:]:
            for image, state, action in zip(query.image, query.state, query.action, strict=True):
                found = np.asarray(policy.act(task_params, milx.Observation(image, state)))
                errors.append(np.mean(((found - action) / training.std(axis=0)) ** 2))
    assert np.mean(errors) == pytest.approx(result["action_error"]["after"], rel=1e-4)


def test_whitening_is_fitted_to_the_training_tasks_alone(finished, folder):
    run, _ = finished
    data = DataSet(folder)
    rows = [demo for task in data.header.of_split("train") for demo in read_resampled(data, task)]
    whitening = milx.load(run.folder).params["whitening"]
    for field in ("state", "action"):
        values = np.concatenate([getattr(row, field) for row in rows])
        np.testing.assert_allclose(getattr(whitening, f"{field}_mean"), values.mean(axis=0), rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(getattr(whitening, f"{field}_scale"), values.std(axis=0), rtol=1e-4)


@pytest.mark.slow
def test_an_interrupted_run_ends_bit_for_bit_like_the_uninterrupted_one(
    finished, folder, tmp_path, monkeypatch, capsys
):
    """Interrupts a run, also one whose data passes by in shards, of which none is whole."""
    config = tiny_config(folder)
    config.train.steps, config.train.log_every, config.train.eval_every = 200, 100, 100
    size = 3 * HORIZON * (12 * 16 * 3 + 4 * 5) * 1.01
    config.recorded.gib = 4 * size / 2**30

    def final(folder):
        run = RecordedRun(config, folder, QUIET)
        assert run.shards.num_tasks == 4
        run.train()
        return milx.load(folder).params

    with monkeypatch.context() as patch:
        validate = RecordedRun._validate

        def stop(self, params):
            patch.setattr(RecordedRun, "_validate", interrupt)
            return validate(self, params)

        def interrupt(self, params):
            raise KeyboardInterrupt

        patch.setattr(RecordedRun, "_validate", stop)
        with pytest.raises(KeyboardInterrupt):
            final(tmp_path / "stopped")
    for name, last in (("terminated", 100), ("terminated late", 200)):
        with monkeypatch.context() as patch:
            write, told = MetricsWriter.write, []

            def terminate(self, step, values, write=write, told=told, last=last):
                if step == last:
                    told.append(step)
                write(self, step, values)

            patch.setattr(MetricsWriter, "write", terminate)
            patch.setattr(signals.Stop, "listen", contextlib.nullcontext)
            asked = property(lambda _, told=told: told and signal.SIGTERM, lambda *_: None)
            patch.setattr(signals.Stop, "asked", asked, raising=False)
            with pytest.raises(SystemExit) as ended:
                final(tmp_path / name)
        assert ended.value.code == 143, "after the last update, too: nothing has been evaluated"
        assert f"milx: stopped at step {last}; the same command goes on from there" in capsys.readouterr().out
    straight = final(tmp_path / "straight")
    best = Checkpoints(tmp_path / "straight" / "checkpoints", read_only=True).best
    for name, step in (("stopped", 200), ("terminated", 100), ("terminated late", 200)):
        folder = tmp_path / name / "checkpoints"
        before = Checkpoints(folder, read_only=True)
        assert before.latest == step
        assert before.score(before.latest) == UNVALIDATED
        jax.tree.map(np.testing.assert_array_equal, final(tmp_path / name), straight)
        after = Checkpoints(folder, read_only=True)
        assert (after.latest, after.best) == (200, best)
        assert after.score(100) > UNVALIDATED


def test_bad_data_is_refused_before_anything_is_compiled(folder, tmp_path):
    config = tiny_config(folder)
    for change, message in (
        ({"path": str(tmp_path)}, "data: .* has no zarr.json, expected a folder written by milx.data"),
        ({"goal_indices": (3,)}, r"recorded.goal_indices: got 3, expected less than 3"),
        ({"horizon": 0}, r"recorded.horizon: got 0, expected a whole number, at least 1"),
        ({"gib": 1e-9}, r"recorded.gib: got 1e-09, expected at least"),
    ):
        bad = dataclasses.replace(config, recorded=dataclasses.replace(config.recorded, **change))
        with pytest.raises(ValueError, match=message):
            RecordedRun(bad, tmp_path / "run", QUIET)
    config.train.shots = 3
    with pytest.raises(ValueError, match=r"expected at least one with more than train.shots = 3 demonstrations"):
        RecordedRun(config, tmp_path / "run", QUIET)


@pytest.mark.slow
def test_where_there_are_no_states_none_are_needed(tmp_path):
    """Goes from the data set to the exported policy, and compares that with `milx.load`."""
    rng = np.random.default_rng(0)
    with Writer(tmp_path / "set", (12, 16), 0, 2, "a test") as writer:
        for task, split in enumerate(("train", "train", "validation", "test")):
            demos = [dataclasses.replace(random_demo(rng, np.ones(2), HORIZON), state=None) for _ in range(2)]
            writer.add(f"task {task}", split, [HORIZON] * 2, demos)
    config = tiny_config(tmp_path / "set")
    config.train.steps = config.train.log_every = config.train.eval_every = config.train.meta_batch = 2
    run = make_run(config, tmp_path / "run", QUIET)
    run.train()
    assert np.isfinite(run.evaluate()["action_error"]["after"])
    policy, demo = milx.load(tmp_path / "run"), demos[0]
    task_params = policy.adapt(policy.params, demo)
    action = policy.act(task_params, milx.Observation(demo.image[0], None))
    export(policy, tmp_path / "out")
    alone = standalone.Policy(tmp_path / "out")
    assert alone.sizes["act"] == {"image": [12, 16, 3]}
    found = alone.act(alone.adapt(image=demo.image, action=demo.action), image=demo.image[0])
    np.testing.assert_allclose(found, action, atol=1e-5)


def test_what_may_be_shown_without_actions_is_not_what_is_asked_for(tmp_path):
    """Gives one of three demonstrations actions: it is the query, whether it comes first or last."""
    rng = np.random.default_rng(0)
    for place in range(3):
        folder = tmp_path / f"set {place}"
        with Writer(folder, (12, 16), 3, 2, "a test") as writer:
            for split in ("train", "validation", "test"):
                demos = [random_demo(rng, np.ones(2), HORIZON) for _ in range(3)]
                demos = [demo if i == place else dataclasses.replace(demo, action=None) for i, demo in enumerate(demos)]
                writer.add(split, split, [HORIZON] * 3, demos)
        config = tiny_config(folder)
        config.method.given, config.network.learned_loss = "video+state", "linear"
        queries, support = make_run(config, tmp_path / f"run {place}", QUIET)._task(1, 2)
        assert queries.acts.tolist() == [True] + [False] * (len(queries.acts) - 1)
        np.testing.assert_array_equal(queries.demo.action[0], DataSet(folder).read(1, place).action)
        assert not any((shown == queries.demo.state[0]).all() for shown in support.state)


def test_the_report_names_the_floors(finished):
    run, result = finished
    run.console = Console(record=True, width=200, file=io.StringIO())
    run.report(result)
    text = run.console.export_text()
    assert f"{result['action_error']['after']:.3f}" in text
    assert f"mean action {result['action_error']['mean_action']:.3f}" in text


def test_a_score_without_anything_to_learn_is_a_number():
    """Divides by the error of the mean action, which is zero where all actions are the same."""
    assert recorded._relative({"after": 0.3, "mean_action": 1.5}, "after") == pytest.approx(0.2)
    assert recorded._relative({"after": 0.0, "mean_action": 0.0}, "after") == 0
    assert UNVALIDATED < 1 - recorded._relative({"after": 300.0, "mean_action": 0.0}, "after") < -1e5


def test_a_run_refuses_data_of_other_sizes_and_stays_as_it_is(finished, folder, tmp_path):
    """Replaces the data set by one with another action, as an import into the same folder would."""
    run, _ = finished
    mine = shutil.copytree(run.folder, tmp_path / "run")
    replaced = write_tasks(tmp_path / "set", lambda action: np.tile(action, 2), action_size=4)
    before = (mine / "spec.json").read_bytes()
    values = json.loads((mine / "config.json").read_text())
    values["recorded"]["path"] = str(replaced)
    (mine / "config.json").write_text(json.dumps(values))
    with pytest.raises(ValueError, match=r"data: .*set has Spec\(.*action_size=4.*\), expected Spec\(.*action_size=2"):
        make_run(assemble.read(mine / "config.json"), mine, QUIET)
    assert (mine / "spec.json").read_bytes() == before
    milx.load(mine)


@pytest.mark.parametrize(
    "values",
    [
        [],
        3,
        None,
        "x",
        {},
        *({"state_size": size} for size in (-1, 1.5, "3", None, True, 10**30, [3])),
        *({"action_size": size} for size in (0, -2, None)),
        *({"image_shape": shape} for shape in ([12], [12, 16, 3], [0, 5], ["a", "b"], 12)),
        *(
            {"action_range": limits}
            for limits in ([[0.0], [1.0]], [1, 2], [[0.0, 1.0], [2.0, None]], [[1e999, 0], [0, 0]])
        ),
        *({"goal_indices": indices} for indices in ([3], [-1], [0.5], 2, [[0]])),
        {"image_to_goal": [[1.0], [2.0]]},
        {"object_indices": [[0]]},
        {"height_index": 9},
        *({"goal_step": step} for step in (0, 1.5)),
        {"spec_version": 2},
        {"new": 1},
    ],
    ids=lambda values: json.dumps(values)[:60],
)
def test_sizes_that_cannot_be_are_refused(finished, tmp_path, values):
    """Changes the file with the sizes of the policy, or replaces it."""
    run, _ = finished
    good = json.loads((run.folder / "spec.json").read_text())
    path = tmp_path / "spec.json"
    path.write_text(json.dumps(good | values if isinstance(values, dict) and values else values))
    with pytest.raises(ValueError, match=r"spec\.json: expected the sizes of a policy: .*(expected|no such field)"):
        read_spec(path)


def test_an_unknown_field_of_the_sizes_is_ignored_if_it_is_none(finished, tmp_path):
    run, _ = finished
    good = run.folder / "spec.json"
    path = tmp_path / "spec.json"
    path.write_text(json.dumps(json.loads(good.read_text()) | {"new": None}))
    assert read_spec(path) == read_spec(good)
