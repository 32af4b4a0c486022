"""Numbers of recorded demonstrations or of their losses that are not finite, and files that are full."""

import io
import json
import resource
import signal
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from directions import random_demo, tiny_config, write_directions, write_tasks
from rich.console import Console
from tiny import QUIET

import milx
from milx.data.dataset import Writer
from milx.methods.mil import MIL
from milx.training.factory import make_run
from milx.training.metrics import MetricsWriter, read_metrics
from milx.training.recorded import RecordedRun


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_directions(tmp_path_factory.mktemp("recording") / "set")


def run_with_losses(folder, workdir, monkeypatch, spoil):
    """Multiplies the loss of every task by `spoil(number of the task)`, and returns the run and its output."""
    config = tiny_config(folder)
    config.train.steps = config.train.eval_every = 60
    config.train.log_every, config.train.meta_batch = 20, 2
    original = MIL.loss

    def loss(self, params, batch, progress=1.0):
        _, metrics = original(self, params, batch, progress)
        each = metrics["loss"] * spoil(batch.task)
        return each.mean(), {**metrics, "loss": each}

    monkeypatch.setattr(MIL, "loss", loss)
    console = Console(record=True, width=200, file=io.StringIO())
    return RecordedRun(config, workdir, console), console


@pytest.mark.slow
def test_updates_that_are_not_finite_are_skipped_counted_and_named(folder, tmp_path, monkeypatch):
    """Spoils one training task of thirty, about one batch of two in fifteen; no parameter sees it."""
    run, console = run_with_losses(folder, tmp_path, monkeypatch, lambda n: jnp.where(n == 17, jnp.nan, 1.0))
    run.train()
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").open()]
    skipped = [line["skipped"] for line in lines if "skipped" in line]
    assert 0 < sum(skipped) < 20
    assert {line["bad_task"] for line in lines if line.get("skipped")} == {17}
    assert all(np.isfinite(line["loss"]) for line in lines if "loss" in line)
    said = console.export_text()
    assert said.count("were skipped: something was not finite, in task 17 of the training set") == np.count_nonzero(
        skipped
    )
    params = milx.load(tmp_path).params
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(params))


@pytest.mark.slow
def test_a_run_without_a_finite_update_stops(folder, tmp_path, monkeypatch):
    run, _ = run_with_losses(folder, tmp_path, monkeypatch, lambda n: jnp.inf * jnp.ones_like(n, jnp.float32))
    monkeypatch.setattr("milx.training.loop.MOST_IN_VAIN", 30)  # after two scans of 20
    with pytest.raises(ValueError, match="no update of the last 40 was finite; there is no checkpoint"):
        run.train()


def test_data_that_are_not_finite_are_refused_by_name(tmp_path):
    rng = np.random.default_rng(0)
    demos = [random_demo(rng, np.ones(2), 8) for _ in range(3)]
    demos[1].action[3, 0] = np.inf
    with Writer(tmp_path / "set", (12, 16), 3, 2, "a test") as writer:
        writer.add("lift", "train", [8, 8, 8], demos)
        for split in ("validation", "test"):
            writer.add(split, split, [8, 8], [random_demo(rng, np.ones(2), 8) for _ in range(2)])
    run = RecordedRun(tiny_config(tmp_path / "set"), tmp_path / "run", QUIET)
    with pytest.raises(
        ValueError, match=r"data: action of demonstration 1 of task 0 \('lift'\): got values that are not"
    ):
        run._load()


@pytest.mark.slow
@pytest.mark.parametrize("value", [1e25, -3e15, np.inf, np.nan])
def test_numbers_whose_squares_are_not_finite_are_refused(cache, tmp_path, value):
    def change(action):
        action = action.copy()
        action[3, 1] = value
        return action

    run = make_run(tiny_config(write_tasks(tmp_path / "set", change)), tmp_path / "run", QUIET)
    expected = r"data: action of demonstration 0 of task 0 .*: got values that are not finite or too large, expected"
    with pytest.raises(ValueError, match=expected):
        run.train()


def test_a_full_disk_stops_neither_training_nor_the_metrics_that_still_fit(tmp_path):
    """Limits the size of files, as a full disk does: both files stop growing, are reported, and nobody waits."""
    reports, before = [], signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    writer = MetricsWriter(tmp_path, 0, reports.append)
    writer.write(1, {"loss": 1.0})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (150, limits[1]))
    began = time.monotonic()
    try:
        for step in range(2, 200):
            writer.write(step, {"loss": 1.0, "validation_success": 0.5})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    assert time.monotonic() - began < 20
    assert sum("TensorBoard's events could not be written: " in report for report in reports) == 1
    assert sum(report.startswith("metrics of step 199 could not be written: ") for report in reports) == 1
    with writer:
        writer.write(200, {"loss": 0.5})  # there is room again
    lines = read_metrics(tmp_path / "metrics.jsonl")
    assert lines[0] == {"step": 1, "loss": 1.0}
