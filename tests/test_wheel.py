"""The wheel holds all that milx needs outside a checkout."""

import os
import pathlib
import shutil
import subprocess
import sys
import zipfile

import pytest

import milx

ROOT = pathlib.Path(__file__).parents[1]
USE = """
import milx, numpy as np
milx.configure()
print(milx.__file__, milx.__version__)
for name in ("reach", "push", "place"):
    policy = milx.load(name)
    spec = policy.spec
    seen = milx.Observation(np.zeros((*spec.image_shape, 3), np.uint8), np.zeros(spec.state_size, np.float32))
    assert np.isfinite(policy.act(policy.params, seen)).all()
from milx.config.schema import DataConfig
from milx.data import experts
experts.expert_of(milx.make("push", (8, 8)), DataConfig(expert="pretrained"))
"""


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Runs Python where the wheel is unpacked, and nothing of the checkout is on the path."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    shutil.copytree(ROOT / "milx", source / "milx", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    subprocess.run([sys.executable, "-m", "build", "--wheel", "--outdir", folder, source], check=True)
    (wheel,) = folder.glob("milx-*.whl")
    site = folder / "site"
    zipfile.ZipFile(wheel).extractall(site)
    environment = os.environ | {"PYTHONPATH": str(site)}

    def run(*arguments):
        command = [sys.executable, *arguments]
        return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)

    return run, site


@pytest.mark.slow
def test_the_policies_and_the_expert_that_ship_are_there(installed):
    run, site = installed
    done = run("-c", USE)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.split() == [str(site / "milx" / "__init__.py"), milx.__version__]


@pytest.mark.slow
def test_the_wheel_is_reproducible(installed, tmp_path):
    """Builds it twice more, at another time and from files of another age: both have the same bytes."""
    _, site = installed
    wheels = []
    for age in (1, 2):
        source = shutil.copytree(site.parent / "source", tmp_path / str(age))
        for path in source.rglob("*"):
            os.utime(path, (10**9 * age, 10**9 * age))
        command = [sys.executable, "-m", "build", "--wheel", "--outdir", tmp_path / f"out{age}", source]
        subprocess.run(command, check=True, env=os.environ | {"SOURCE_DATE_EPOCH": "1700000000"})
        (wheel,) = (tmp_path / f"out{age}").iterdir()
        wheels.append(wheel.read_bytes())
    assert wheels[0] == wheels[1]


@pytest.mark.slow
def test_launchers_start(installed):
    run, _ = installed
    done = run("-m", "milx.train", "--config.train.steps=7")
    assert "train.steps: got 7, expected a positive multiple of train.log_every" in done.stderr, done.stderr[-2000:]
