"""Lives disturbed once by each kind of failure; `experiments/robustness/failures.py` has a life for every operation."""

import concurrent.futures
import pathlib
import sys

import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "experiments" / "robustness"))
import failures

pytestmark = pytest.mark.slow


def test_a_life_that_is_disturbed_ends_as_it_should_and_goes_on_to_the_same_parameters(tmp_path):
    """Disturbs seven lives, at operations spread over importing, training, evaluating and exporting."""
    failures.write_recording(tmp_path)
    (tmp_path / "good").mkdir()
    good = failures.begin(tmp_path / "good")
    assert good.code == 0, good.errors[-2000:]
    operations = good.result["operations"]
    assert operations > 500
    numbers = [round((i + 0.5) * operations / len(failures.KINDS)) for i in range(len(failures.KINDS))]
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        fail = lambda number, kind: failures.fail_once(tmp_path, number, kind, good.result["params"])  # noqa: E731
        lives = list(pool.map(fail, numbers, failures.KINDS))
    assert [(life["operation"], life["kind"], life["wrong"]) for life in lives if life["wrong"]] == []
    assert {life["code"] for life in lives} >= {-9, 129, 130, 143}


def test_what_goes_wrong_is_noticed():
    """Judges lives that ended as they should not."""
    good, silent = (failures.Outcome(code, 1.0, "", "", {"params": "a"}) for code in (0, 1))
    assert failures.wrong(good, good, "EIO", "a") == []
    assert failures.wrong(good, good, "EIO", "b")[0] == "ended well with other parameters"
    assert failures.wrong(good, silent, "EIO", "a")[0].startswith("begun again, it ended with 1")
    assert failures.wrong(silent, good, "EIO", "a") == ["no message, or a traceback in its place"]
    loud = silent._replace(errors="milx: a checkpoint was damaged\nTraceback (most recent call last):\nKeyError: 1\n")
    assert failures.wrong(loud, good, "EIO", "a") == ["no message, or a traceback in its place"]
    told = silent._replace(errors="milx: a disk is full\n")
    assert failures.wrong(told, good, "EIO", "a") == []
    assert failures.wrong(silent, good, "SIGTERM", "a")[0] == "exit code 1, expected 143"
