"""The Meta-World board: its rows and its table."""

import pathlib
import sys

import numpy as np
import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "experiments" / "metaworld"))
import board

from milx.config import assemble
from milx.config.check import check_config
from milx.data.dataset import Writer
from milx.types import Demo


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Writes a data set with the sizes of Meta-World's."""
    folder, steps = tmp_path_factory.mktemp("board") / "set", 3
    demo = Demo(np.zeros((steps, 64, 64, 3), np.uint8), *(np.zeros((steps, 4), np.float32) for _ in range(2)))
    with Writer(folder, (64, 64), 4, 4, "a test") as writer:
        for split in ("train", "validation", "test"):
            writer.add(split, split, [steps], [demo])
    return folder


@pytest.mark.parametrize("row", board.ROWS)
def test_rows_are_configurations_of_their_own(folder, row):
    config = board.configure(row, str(folder), 3)
    check_config(config)
    others = [board.configure(other, str(folder), 3) for other in board.ROWS if other != row]
    assert all(assemble.to_dict(config) != assemble.to_dict(other) for other in others)


def test_results_are_of_the_rows(folder):
    found = board.read()
    assert found
    for name, run in found.items():
        row, _, seed = name.rpartition("-")
        expected = assemble.to_dict(board.configure(row, str(folder), int(seed)))
        expected["recorded"]["path"] = run["config"]["recorded"]["path"]
        ran = assemble.to_dict(assemble.from_dict(run["config"]))  # fields that came later have their defaults
        expected |= {group: ran[group] for group in ("env", "data")}  # which nothing reads
        assert not assemble.differences(expected, ran), name
        assert run["world"]["controls"]["own"]["lost"] == 0


def test_the_table_has_a_line_for_each_control():
    def rates(ever, end, episodes):
        return {"ever": ever, "end": end, "episodes": episodes, "ever_wilson95": [ever - 0.1, ever + 0.1]}

    controls = {
        name: rates(ever, 0.25, 8) | {"families": {"push-v3": rates(ever, 0.0, 4), "reach-v3": rates(1.0, 0.0, 4)}}
        for name, ever in (("own", 0.75), ("random", 0.125))
    }
    run = {"world": {"controls": controls}}
    lines = board.markdown({"mil-7": run, "lstm-0": run}).splitlines()
    assert lines[0] == "|  | after | success (95%) | at the end | episodes | push | reach |"
    assert lines[1] == "|---" * 7 + "|"
    label = "MIL + learned rates, chunks, seed 7"
    assert lines[2] == f"| {label} | its own demonstration | 75.0% (65% to 85%) | 25.0% | 8 | 75% | 100% |"
    assert lines[3].startswith("| LSTM + chunks, seed 0 | its own demonstration | 75.0%")
    assert lines[4:] == ["| no policy | random actions | 12.5% (2% to 22%) | 25.0% | 8 | 12% | 100% |"]
