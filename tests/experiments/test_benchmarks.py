"""What is made of several runs of a benchmark: medians, and by which factor milx is better."""

import json
import pathlib
import sys

import pytest
from absl import app, flags

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "experiments" / "benchmarks"))
import everything
import summary

SCRIPT = """
import json, os, pathlib, sys
folder = pathlib.Path(sys.argv[1].removeprefix("--out="))
run = int(folder.name)
folder.mkdir(parents=True)
rows = [{"name": "milx", "median": [3.0, 9.0, 1.0, 2.0][run], "unit": "ms", "peak_memory_gib": run + 0.5}]
rows += [{"name": "peer", "median": None if run == 2 else 6.0, "unit": "ms", "peak_memory_gib": None}]
said = {"benchmark": "slow", "commit": os.environ["MILX_COMMIT"]}
(folder / "slow.json").write_text(json.dumps({**said, "rows": rows[:1] if run == 3 else rows}))
sys.exit(4 if run == 1 else 0)
"""


@pytest.fixture
def run_everything(tmp_path, monkeypatch):
    """Returns a function that runs the launcher, with SCRIPT as the benchmark "physics"."""
    (tmp_path / "physics.py").write_text(SCRIPT)
    monkeypatch.setattr(everything, "HERE", tmp_path)
    values = flags.FlagValues()
    everything.define_flags(values)
    monkeypatch.setattr(everything, "FLAGS", values)

    def run(*arguments):
        values(["everything", f"--out={tmp_path / 'out'}", *arguments])
        everything.main([])

    return run


def test_runs_that_worked_are_merged_and_the_others_are_told(run_everything, tmp_path, monkeypatch):
    commits = iter(["clean", *["dirty"] * 4])  # since the files of the first run lie in the tree
    monkeypatch.setattr(everything.provenance, "commit", lambda: next(commits))
    with pytest.raises(SystemExit, match=r"everything: failed: physics, run 2$"):
        run_everything("--only=physics", "--runs=4")
    found = json.loads((tmp_path / "out" / "slow.json").read_text())
    assert found["commit"] == "clean"
    ours, peer = found["rows"]
    assert (ours["median"], ours["runs"], ours["peak_memory_gib"]) == (2.0, [3.0, 1.0, 2.0], 3.5)
    assert (peer["median"], peer["runs"], peer["peak_memory_gib"]) == (6.0, [6.0, None, None], None)


def test_meshes_need_models(run_everything):
    with pytest.raises(app.UsageError, match="--only=meshes: expected --mjcf"):
        run_everything("--only=physics", "--only=meshes")


def row(name, *runs, unit="ms"):
    return {"name": name, "median": sorted(runs)[len(runs) // 2], "unit": unit, "runs": list(runs)}


@pytest.mark.parametrize(("unit", "fast", "slow"), [("ms", 2.0, 6.0), ("", 2.0, 6.0), ("frames/s", 6.0, 2.0)])
def test_milx_is_better_by_as_much_as_it_is_faster(unit, fast, slow):
    assert summary.factor(fast, slow, unit) == 3.0
    assert summary.factor(slow, fast, unit) == pytest.approx(1 / 3)


def test_the_spread_is_that_of_the_ratios_in_the_same_run():
    """Both slow down together, so their ratio is the same in every run, though each spreads by a factor of two."""
    result = {
        "benchmark": "b",
        "hardware": "1 x NVIDIA",
        "rows": [row("case: milx", 1.0, 2.0, 1.5), row("case: peer", 3.0, 6.0, 4.5)],
    }
    for each in result["rows"]:
        each |= {"peak_memory_gib": None, "note": ""}
    *_, peer = summary.table([result]).splitlines()
    assert peer == "| b | case: peer | 4.5 ms (3 to 6) | 3 (3 to 3) |  |"


def test_a_peer_is_compared_with_what_answers_the_same_question_at_the_same_precision():
    rows = [
        row("case: milx, bfloat16", 1.0),
        row("case: milx, float32", 2.0),
        row("case: peer, float32", 4.0),
        row("case: bound", 0.5),
        row("other: peer, float32", 8.0),
        row("case: peer, float32, rate", 8.0, unit="1/s"),
    ]
    asked = summary.questions({"benchmark": "b", "hardware": "", "rows": rows})
    rivals = {each["name"]: question.rival(each) for question in asked for each in question.rows}
    assert rivals == {
        "case: milx, bfloat16": None,
        "case: milx, float32": None,
        "case: peer, float32": rows[1],
        "case: bound": rows[0],
        "other: peer, float32": None,
        "case: peer, float32, rate": None,
    }


@pytest.mark.parametrize("peers", [1, 2])
def test_a_panel_is_drawn_for_each_question_that_has_a_peer(tmp_path, peers, monkeypatch):
    """Reads the panels back before they are closed."""
    rows = [row(f"{case}: {who}", 2.0) for case in "ab"[:peers] for who in ("milx", "peer")] + [row("c: milx", 1.0)]
    drawn = []
    monkeypatch.setattr(summary.plt, "close", drawn.append)
    summary.draw([{"benchmark": "speed", "hardware": "1 x x86_64", "rows": rows}], tmp_path / "chart.png")
    panels = [axis for axis in drawn[0].axes if axis.axison]
    expected = [f"speed-cpu, {case}\nms, less is better, 1 x x86_64" for case in "ab"[:peers]]
    assert [axis.get_title() for axis in panels] == expected
    assert [[bar.get_width() for bar in axis.patches] for axis in panels] == [[2.0, 2.0]] * peers
