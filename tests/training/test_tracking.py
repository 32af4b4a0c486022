"""Metrics in Weights & Biases, without a network."""

import contextlib
import json
import struct
import sys
import time

import pytest

from milx.config.assemble import make_config
from milx.training.metrics import MetricsWriter, read_metrics
from milx.training.tracking import Tracker


@pytest.fixture
def tracker(tmp_path, monkeypatch):
    """Makes what starts a tracker whose files stay in the folder."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    config = make_config("reach")
    config.train.wandb = "milx-tests"
    return lambda: Tracker(tmp_path, config)


def losses(log):
    """Reads the losses in a file of wandb's: records, each after a checksum, its length and its kind."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, found = log.read_bytes(), []
    assert len(data) < 1 << 15, "the file is one block"
    start = 7  # of the file's header
    while start < len(data):
        _, length, _ = struct.unpack_from("<IHB", data, start)
        start += 7 + length
        items = Record.FromString(data[start - length : start]).history.item
        found += [json.loads(item.value_json) for item in items if "loss" in (item.key, *item.nested_key)]
    return found


@pytest.mark.slow
def test_a_run_that_goes_on_hands_all_its_lines_to_the_same_run_of_wandb(tmp_path, tracker):
    reports = []
    for first in (1, 2):
        with MetricsWriter(tmp_path, first - 1, reports.append, tracker) as writer:
            for step in range(first, first + 2):
                writer.write(step, {"loss": 1.0 / (1 << step)})
        time.sleep(1.1)  # the names of wandb's folders have seconds
    assert not reports
    logs = sorted((tmp_path / "wandb").glob("offline-run-*/run-*.wandb"))
    assert len({path.name for path in logs}) == 1
    assert [losses(path) for path in logs] == [[0.5, 0.25], [0.25, 0.125]]


def test_without_wandb_training_goes_on(tmp_path, tracker, monkeypatch):
    reports = []
    monkeypatch.setitem(sys.modules, "wandb", None)  # as if it were not installed
    with MetricsWriter(tmp_path, 0, reports.append, tracker) as writer:
        for step in (1, 2):
            writer.write(step, {"loss": 0.5})
    assert len(reports) == 1
    assert reports[0].startswith("wandb's metrics could not be written: import of wandb")
    assert [line["step"] for line in read_metrics(tmp_path / "metrics.jsonl")] == [1, 2]


def test_a_failure_of_wandb_is_reported_once(tmp_path, tracker):
    reports = []
    with MetricsWriter(tmp_path, 0, reports.append, tracker) as writer:
        assert writer._tracker is not None
        writer._tracker._run.finish()  # so that it takes no more
        for step in (1, 2):
            writer.write(step, {"loss": 0.5})
    assert [report.partition(": ")[0] for report in reports] == ["wandb's metrics could not be written"]


def test_a_run_that_somebody_else_has_begun_stays_theirs(tmp_path, tracker):
    import wandb

    theirs, reports = wandb.init(project="theirs", dir=str(tmp_path)), []
    with MetricsWriter(tmp_path, 0, reports.append, tracker) as writer:
        writer.write(1, {"loss": 0.5})
    theirs.log({"mine": 0.125})
    assert theirs.summary["mine"] == 0.125
    assert theirs.summary.get("loss") is None
    theirs.finish()
    assert not reports


@pytest.mark.parametrize("fails", [False, True])
def test_wandb_is_told_whether_a_run_has_failed(tmp_path, tracker, fails):
    codes = []
    with contextlib.suppress(FloatingPointError), MetricsWriter(tmp_path, 0, print, tracker) as writer:
        assert writer._tracker is not None
        finish = writer._tracker._run.finish
        writer._tracker._run.finish = lambda exit_code: (codes.append(exit_code), finish(exit_code))
        if fails:
            raise FloatingPointError
    assert codes == [int(fails)]
