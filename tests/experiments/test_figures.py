"""What figures and tables make of result files."""

import pathlib
import sys

import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "experiments"))
import cells
import figure3
import push_tables
import table1
import table2

from milx import methods
from milx.envs.push import Push
from milx.policy import spec_of


def result(size, success, low, high, method="mil"):
    return {"env": "reach", "method": method, "num_demos_train": size, "success": success, "wilson95": [low, high]}


def test_a_point_is_the_mean_of_its_seeds_within_all_their_intervals():
    results = [result(500, 0.8, 0.7, 0.85), result(100, 0.4, 0.3, 0.5), result(500, 0.6, 0.55, 0.66)]
    curves = figure3.points([*results, result(500, 0.1, 0.0, 0.2, "lstm")])
    assert list(curves["reach", "mil"]) == [100, 500]
    assert curves["reach", "mil"][500] == pytest.approx((0.7, 0.55, 0.85, 2))
    assert curves["reach", "lstm"][500] == pytest.approx((0.1, 0.0, 0.2, 1))


@pytest.mark.parametrize("rows", [table1.ROWS, table2.ROWS])
def test_rows_of_push_are_trained_once_for_all_shots_and_each_on_its_own(rows, tmp_path, flags):
    spec, runner, programs = spec_of(Push((48, 48))), cells.Cells(tmp_path, 769), set()
    for row in rows.values():
        one, five = (push_tables.configure(row, shots, seed=0) for shots in push_tables.SHOTS)
        methods.make(one, spec)  # refuses what does not fit together
        assert runner._programs(one) == runner._programs(five)
        assert (one.evaluation.shots, five.evaluation.shots) == (1, 5)
        programs.add(runner._programs(one))
    assert len(programs) == len(rows)


def test_an_unknown_row_is_refused(flags):
    flags.rows = ["mil-vidoe"]
    with pytest.raises(ValueError, match="rows: got 'mil-vidoe', expected some of one-head, two-heads"):
        push_tables.make("table2", table2.ROWS)


@pytest.fixture
def flags():
    """The scripts' flags, parsed; what a test sets is undone."""
    from absl import flags

    saved = flags.FLAGS
    saved(["test"])
    yield saved
    saved.unparse_flags()
    saved.rows = None
