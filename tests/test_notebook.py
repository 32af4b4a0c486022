"""The notebook runs from top to bottom, at tiny sizes, and is stored without outputs."""

import base64
import io
import pathlib
import re
import sys

import imageio.v3 as iio
import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

NOTEBOOKS = pathlib.Path(__file__).parents[1] / "experiments" / "notebooks"
PATH = NOTEBOOKS / "quickstart.ipynb"


@pytest.fixture(scope="module")
def executed(cache, tmp_path_factory):
    notebook, folder = nbformat.read(PATH, as_version=4), str(tmp_path_factory.mktemp("notebook"))
    client = NotebookClient(notebook, timeout=900, resources={"metadata": {"path": folder}})
    # The kernel of the environment that runs the tests, whatever else is installed.
    client.create_kernel_manager()
    client.km.kernel_spec.argv[0] = sys.executable
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", folder)
        patch.setenv("MILX_NOTEBOOK_STEPS", "4")
        patch.setenv("MILX_NOTEBOOK_TASKS", "2")
        client.execute()
    return notebook


def code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def printed(notebook):
    cells = [output for cell in code(notebook) for output in cell.outputs if output.output_type == "stream"]
    return "".join(output.text for output in cells)


def test_notebooks_are_stored_clean():
    paths = sorted(NOTEBOOKS.glob("*.ipynb"))
    assert PATH in paths
    for path in paths:
        assert not re.search(r"/(work|root|home|tmp|Users)/", path.read_text()), path
        for cell in code(nbformat.read(path, as_version=4)):
            assert cell.outputs == [], path
            assert cell.execution_count is None, path


def test_first_code_cell_tells_how_to_install():
    assert "# %pip install milx" in code(nbformat.read(PATH, as_version=4))[0].source.splitlines()


def test_last_output_shows_the_demonstration_beside_another_rollout(executed):
    (output,) = code(executed)[-1].outputs
    frames = iio.imread(io.BytesIO(base64.b64decode(output.data["image/gif"])), extension=".gif", index=None)
    height, width = 128, 160
    assert frames.shape[1:] == (height, 2 * width + 8, 3)
    left, right = frames[:, :, :width].astype(int), frames[:, :, -width:].astype(int)
    gap = frames[:, 2:-2, width + 2 : -width - 2]
    assert gap.min() > 240
    # The cubes stand elsewhere from the first frame on, in the same colours.
    assert (np.abs(left - right).max(axis=-1) > 40).mean(axis=(1, 2)).min() > 0.01
    # Both arms move.
    for half in (left, right):
        assert (np.abs(half[0] - half[-1]).max(axis=-1) > 40).sum() > 20


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
