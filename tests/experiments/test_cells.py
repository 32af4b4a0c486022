"""Cells of a figure are runs, and a finished one is not run again."""

import dataclasses
import pathlib
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from tiny import tiny_config

from milx.training.state import save_state

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "experiments" / "paper"))
import cells


@pytest.mark.slow
def test_a_cell_is_a_run(trained, tmp_path, monkeypatch):
    """Compares success, demonstrations and baselines to the last bit: same seeds, tasks and trials, killed or not."""
    monkeypatch.setattr(cells.envs, "make", lambda *_: trained.run.env)  # spares what is compiled for it
    runner, config = cells.Cells(tmp_path, trained.config.data.tasks), tiny_config()
    saved = []

    def killed(*args):
        """Writes a checkpoint, and the first time the process ends right after it."""
        written = save_state(*args)
        saved.append(int(args[1].step))
        if len(saved) == 1:
            raise KeyboardInterrupt
        return written

    monkeypatch.setattr(cells, "save_state", killed)
    with pytest.raises(KeyboardInterrupt):
        runner.run({"cell": config})
    runner = cells.Cells(tmp_path, trained.config.data.tasks)  # as in another process
    runner.run({"cell": config})
    assert saved == [2, 2, 4, 4, 6, 6]  # it has gone on from there; each is saved before and after its validation
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cell.json", "unfinished"]
    assert not list((tmp_path / "unfinished").iterdir())
    result = cells.read(tmp_path)["cell"]
    for field in ("success", "trials", "wilson95", "baselines", "dataset_hash"):
        assert result[field] == trained.result[field], field
    assert result["validation_success"] == max(line.get("validation_success", 0) for line in trained.metrics)

    before = (tmp_path / "cell.json").stat().st_mtime_ns
    config.evaluation.batch, config.data.plan_batch = 7, 7  # how much runs at once is no part of a cell
    assert runner.is_done("cell", config)
    runner.run({"cell": config})
    assert (tmp_path / "cell.json").stat().st_mtime_ns == before

    config.optimizer.learning_rate = 0.5
    with pytest.raises(ValueError, match=r"cell.json: holds another cell: optimizer.learning_rate was 0.002, now 0.5"):
        runner.run({"cell": config})
    monkeypatch.setattr(cells.envs.find(config.env_name), "version", trained.run.env.version + 1)
    with pytest.raises(ValueError, match=r"cell.json: holds a cell of version \d+ of \w+, expected \d+; remove"):
        runner.run({"cell": config})


def test_a_checkpoint_belongs_to_configuration_commit_and_versions_but_to_no_machine(tmp_path, monkeypatch):
    config, origin = tiny_config(), {"commit": "a", "hardware": "one GPU", "versions": {"jax": "0.11"}}

    def identity(**changes):
        monkeypatch.setattr(cells.provenance, "origin", lambda: origin | changes)
        return cells.Cells(tmp_path, 8)._identity(config)

    first = identity()
    assert identity(hardware="another GPU") == first
    assert identity(commit="b") != first
    assert identity(versions={"jax": "0.12"}) != first
    config.optimizer.learning_rate = 0.5
    assert identity() != first


def test_bad_cells_are_refused_before_anything_is_planned(tmp_path):
    runner, config = cells.Cells(tmp_path, 8), tiny_config()
    config.data.tasks = 3
    with pytest.raises(ValueError, match=r"data\.tasks: got 3, expected a divisor of 8"):
        runner.run({"cell": config})
    config = dataclasses.replace(tiny_config(), train=dataclasses.replace(tiny_config().train, eval_every=3))
    with pytest.raises(ValueError, match=r"train\.eval_every: got 3, expected a positive multiple"):
        runner.run({"cell": config})
    assert not list(tmp_path.iterdir())


def test_an_unknown_method_is_refused():
    assert cells.methods_of("reach", ["lstm", "lstm_attention"]) == ["lstm"]  # no attention over pixels
    with pytest.raises(ValueError, match="methods: got 'ltsm', expected some of contextual, lstm, lstm_attention, mil"):
        cells.methods_of("reach", ["ltsm"])


@pytest.mark.parametrize("captures", [False, True])
def test_all_is_compiled_before_graphs_are_captured(captures, tmp_path, monkeypatch):
    planning, compiled, config = threading.Event(), [], tiny_config()

    def compile_in_background(*_):
        """Compiles until demonstrations are planned, which must not begin before where graphs are captured."""
        compiled.append(thread.submit(planning.wait, 0.2 if captures else 10.0))
        return compiled

    def plan(self, config):
        planning.set()
        raise KeyboardInterrupt

    monkeypatch.setattr(cells, "compile_in_background", compile_in_background)
    monkeypatch.setattr(cells.Cells, "_first_tasks", plan)
    monkeypatch.setattr(cells.envs.find(config.env_name), "captures_graphs", captures)
    with ThreadPoolExecutor(max_workers=1) as thread, pytest.raises(KeyboardInterrupt):
        cells.Cells(tmp_path, config.data.tasks).run({"cell": config})
    assert compiled[0].result() is not captures, "whether planning began while programs were compiled"
