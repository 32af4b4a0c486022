"""What earlier versions have written is read: data sets, runs, exports and policies in `fixtures/golden/VERSION`."""

import json
import pathlib
import shutil
import subprocess
import sys

import numpy as np
import pytest

import milx
from milx.config import assemble
from milx.config.assemble import make_config
from milx.core import pytrees
from milx.core.checkpoint import Checkpoints
from milx.data.dataset import DataSet
from milx.deploy import pretrained, standalone
from milx.deploy.policy import read_spec

FIXTURES = pathlib.Path(__file__).parent / "fixtures"
sys.path.insert(0, str(FIXTURES))
import make_golden  # noqa: E402

VERSIONS = pytest.mark.parametrize("folder", sorted(make_golden.GOLDEN.iterdir()), ids=lambda folder: folder.name)


@pytest.fixture
def action(folder):
    """Returns the action after one demonstration, as the version that wrote the files computed it."""
    return np.array(json.loads((folder / "action.json").read_text()))


@VERSIONS
def test_a_data_set_is_read(folder):
    data = DataSet(folder / "set")
    assert [(task.name, task.split) for task in data.header.tasks] == [
        ("task 0", "train"),
        ("task 1", "validation"),
        ("task 2", "test"),
    ]
    for task in range(3):
        for number in range(2):
            read, expected = data.read(task, number), make_golden.demo(2 * task + number)
            for field in ("image", "state", "action"):
                np.testing.assert_array_equal(getattr(read, field), getattr(expected, field))


@VERSIONS
def test_a_run_is_loaded_and_its_policy_acts_as_it_did(folder, action, tmp_path):
    policy = milx.load(shutil.copytree(folder / "run", tmp_path / "run"))
    task_params = policy.adapt(policy.params, make_golden.demo(0))
    seen = make_golden.demo(1)
    found = policy.act(task_params, milx.Observation(seen.image[0], seen.state[0]))
    np.testing.assert_allclose(found, action, rtol=0, atol=1e-5)
    assert (
        np.abs(np.asarray(policy.act(policy.params, milx.Observation(seen.image[0], seen.state[0]))) - action).max()
        > 1e-3
    )


@VERSIONS
def test_an_export_acts_as_it_did(folder, action):
    """Loads it with the loader of today and, in a process of its own, with the loader beside it."""
    seen, shown = make_golden.demo(1), make_golden.demo(0)
    policy = standalone.Policy(folder / "exported")
    task_params = policy.adapt(image=shown.image, state=shown.state, action=shown.action)
    found = policy.act(task_params, image=seen.image[0], state=seen.state[0])
    np.testing.assert_allclose(found, action, rtol=0, atol=1e-5)
    program = f"import sys; sys.path.insert(0, {str(folder / 'exported')!r})\nfrom policy import Policy\n"
    program += f"print(len(Policy({str(folder / 'exported')!r}).params))"
    done = subprocess.run([sys.executable, "-B", "-c", program], capture_output=True, text=True, check=True)
    assert int(done.stdout) == len(policy.params)


@VERSIONS
def test_a_shipped_policy_is_loaded_and_its_parameters_are_those_that_were_written(folder, monkeypatch):
    monkeypatch.setattr(pretrained, "FOLDER", folder / "shipped")
    policy, stored = milx.load("small"), pretrained.result("small")
    assert stored["params_hash"] == pytrees.fingerprint(policy.params)
    assert policy.config == make_config("reach_state", preset="cpu")


def test_a_later_version_is_refused_by_its_number(tmp_path, monkeypatch):
    """Raises the number of every format beyond the newest; each is refused with its name and both numbers."""
    folder = shutil.copytree(make_golden.GOLDEN / milx.__version__, tmp_path / "golden")

    def raised(name, *path, by=1):
        values = json.loads((folder / name).read_text())
        group = values
        for part in path[:-1]:
            group = group[part]
        group[path[-1]] = group.get(path[-1], 1) + by
        (folder / name).write_text(json.dumps(values))

    raised("run/config.json", "config_version", by=2)
    raised("run/spec.json", "spec_version")
    raised("set/zarr.json", "attributes", "milx", "version", by=2)
    raised("exported/policy.json", "format")
    raised("shipped/small/result.json", "format")
    monkeypatch.setattr(pretrained, "FOLDER", folder / "shipped")
    raised("run/checkpoints/10/extra/metadata", "format")
    (folder / "run/checkpoints/10/checksums.json").unlink()
    like = {"params": milx.load(make_golden.GOLDEN / milx.__version__ / "run").params}
    for read, message in (
        (lambda: assemble.read(folder / "run/config.json"), "config_version: got 5, expected at most 4"),
        (lambda: read_spec(folder / "run/spec.json"), "spec_version: got 2, expected 1: made by a later milx"),
        (lambda: DataSet(folder / "set"), "version: got 3, expected 1 to 2"),
        (lambda: standalone.Policy(folder / "exported"), "format: got 2, expected 1"),
        (lambda: milx.load("small"), "result.json: got format 2, expected 1: it may be of a later milx"),
        (
            lambda: Checkpoints(folder / "run/checkpoints", read_only=True).restore(10, like),
            "10: got format 2, expected 1: it may have been made by a later milx",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            read()
