"""The notebooks run from top to bottom, at tiny sizes, and are stored with the outputs of a full run."""

import ast
import base64
import io
import pathlib
import re
import sys
import tempfile

import imageio.v3 as iio
import nbformat
import numpy as np
import pytest

NAMES = ("after", "before", "mean_action", "other_task")
NOTEBOOKS = pathlib.Path(__file__).parents[1] / "experiments" / "notebooks"
sys.path.insert(0, str(NOTEBOOKS))

import execute as execute_notebook  # noqa: E402


@pytest.fixture(scope="module")
def execute(cache, quick_path, tmp_path_factory):
    """Runs a notebook with so many meta-updates and tasks; returns it with its outputs."""

    def run(name, steps, tasks):
        folder = tmp_path_factory.mktemp("notebook")
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("PYTHONPATH", quick_path)
            patch.setenv("TMPDIR", str(folder))
            patch.setenv("MILX_NOTEBOOK_STEPS", str(steps))
            patch.setenv("MILX_NOTEBOOK_TASKS", str(tasks))
            return execute_notebook.executed(name, folder)

    return run


@pytest.fixture(scope="module")
def executed(execute):
    return execute("quickstart", steps=4, tasks=2)


def code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def printed(notebook):
    cells = [output for cell in code(notebook) for output in cell.outputs if output.output_type == "stream"]
    return "".join(output.text for output in cells)


def test_notebooks_are_stored_as_they_ran_from_top_to_bottom():
    paths = sorted(NOTEBOOKS.glob("*.ipynb"))
    assert len(paths) == 4
    for path in paths:
        assert not re.search(r"/(work|root|home|Users)/|/tmp/tmp", path.read_text()), path
        cells = code(nbformat.read(path, as_version=4))
        assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1)), path
        kinds = {output.output_type for cell in cells for output in cell.outputs}
        assert {"stream", "display_data", "execute_result"} & kinds and "error" not in kinds, path


def test_paths_of_temporary_folders_are_not_stored():
    with tempfile.TemporaryDirectory() as folder:
        assert execute_notebook.neutral(f"{folder}/data: 60 tasks") == "/tmp/notebook/data: 60 tasks"


def test_first_code_cell_tells_how_to_install():
    for path in NOTEBOOKS.glob("*.ipynb"):
        assert re.search(r'^# %pip install "?milx', code(nbformat.read(path, as_version=4))[0].source, re.MULTILINE)


@pytest.mark.slow
def test_last_output_shows_the_demonstration_beside_another_rollout(executed):
    (output,) = code(executed)[-1].outputs
    frames = iio.imread(io.BytesIO(base64.b64decode(output.data["image/gif"])), extension=".gif", index=None)
    height, width = 128, 160
    assert frames.shape[1:] == (height, 2 * width + 8, 3)
    left, right = frames[:, :, :width].astype(int), frames[:, :, -width:].astype(int)
    gap = frames[:, 2:-2, width + 2 : -width - 2]
    assert gap.min() > 240
    # The cubes stand elsewhere from the first frame on, in the same colors.
    assert (np.abs(left - right).max(axis=-1) > 40).mean(axis=(1, 2)).min() > 0.01
    # Both arms move.
    for half in (left, right):
        assert (np.abs(half[0] - half[-1]).max(axis=-1) > 40).sum() > 20


@pytest.mark.slow
def test_training_and_adaptation_did_something(executed):
    text = printed(executed)
    step, loss = re.search(r"^step (\d+), .*\bloss ([\d.e+-]+)", text, re.MULTILINE).groups()
    assert int(step) == 4
    assert 0 < float(loss) < np.inf
    actions = {
        name: np.array(re.search(name + r":\s*\[([^\]]+)\]", text).group(1).split(), float)
        for name in ("expert", "before adapting", "after adapting")
    }
    assert all(action.shape == (2,) and np.isfinite(action).all() for action in actions.values())
    assert np.abs(actions["after adapting"] - actions["before adapting"]).max() > 1e-6


@pytest.mark.slow
def test_a_task_of_ones_own_is_planned_trained_and_judged(execute):
    notebook = execute("train_your_own_task", steps=4, tasks=2)
    found = re.search(r"success ([\d.]+)% of 20 trials; baselines and upper bound: (\{.*\})", printed(notebook))
    assert 0 <= float(found.group(1)) <= 100
    assert set(ast.literal_eval(found.group(2))) == {"random", "task_blind", "expert", "other_demo"}
    (scene,) = code(notebook)[5].outputs
    image = iio.imread(base64.b64decode(scene.data["image/png"]))
    rows, columns = np.nonzero((image == 255).all(axis=-1))
    assert (np.ptp(rows), np.ptp(columns)) == (4, 4), "the mark"


@pytest.mark.slow
def test_demonstrations_of_ones_own_are_learned_from(execute):
    """Compares policies adapted to a demonstration with those adapted to another task's."""
    text = printed(execute("bring_your_own_demonstrations", steps=400, tasks=0))
    errors = {name: float(re.search(rf"^{name} +([\d.]+)", text, re.MULTILINE).group(1)) for name in NAMES}
    assert errors["after"] < 0.5 * errors["before"]
    assert errors["other_task"] > errors["mean_action"]
    assert "'adapt.bin'" in text
    assert re.search(r"exported policy: \[", text)


@pytest.mark.slow
def test_curves_characters_and_a_loss_are_meta_learned(execute):
    text = printed(execute("meta_learn_anything", steps=60, tasks=24))
    own, other = (
        float(re.search(rf"after {name}: ([\d.]+)%", text).group(1))
        for name in ("its own demonstration", "another one's")
    )
    assert own > other
    before, after = map(float, re.search(r"meta-learned: error ([\d.]+), after one step ([\d.]+)", text).groups())
    average = float(re.search(r"average: error [\d.]+, after one step ([\d.]+)", text).group(1))
    assert after < 0.9 * before
    assert after < average
    found = re.search(r"5-way, 1-shot: ([\d.]+)% after one step, ([\d.]+)% before", text)
    assert float(found.group(1)) > 50, "guessing has 20%, and so have parameters before the step"
    assert float(found.group(2)) < 35
