"""Where MuJoCo is not installed, all works that does not simulate in milx's own environments."""

import json
import os
import pathlib
import subprocess
import sys

import numpy as np
import pytest

from milx.data.dataset import Writer
from milx.types import SPLITS, Demo

FAILURES = pathlib.Path(__file__).parents[1] / "experiments" / "robustness"
sys.path.insert(0, str(FAILURES))
import failures  # noqa: E402

BLOCK = """
import sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "mujoco":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocked())
"""


def run(program, *arguments):
    """Runs a program in a process in which mujoco cannot be imported."""
    command = [sys.executable, "-c", BLOCK + program, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env={**os.environ, "JAX_PLATFORMS": "cpu"})


def test_only_environments_need_it():
    program = """
import milx, milx.collect, milx.evaluate, milx.export, milx.train
import milx.data.check, milx.data.lerobot, milx.data.robomimic
from milx.config.assemble import make_config
from milx.training.factory import make_run

for needs in (
    lambda: milx.make("reach"), lambda: milx.load("push"), lambda: make_run(make_config("place", preset="cpu"), "run"),
    lambda: milx.make("grasp")
):
    try:
        needs()
    except ValueError as error:
        print(error)
"""
    done = run(program)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.splitlines() == [
        f"env: {name!r} needs MuJoCo: install milx with the extra 'sim'" for name in ("reach", "push", "place", "grasp")
    ]
    assert done.stderr == ""


def test_the_parameters_of_a_shipped_policy_need_none():
    """Prints how many arrays a policy for recorded demonstrations takes from push, and from which configuration."""
    program = """
from milx import methods
from milx.config.assemble import make_config
from milx.deploy.pretrained import parameters
from milx.training.start import start_from
from milx.types import Spec

config, spec = make_config("recorded", preset="fast"), Spec((16, 16), 4, 4, None, ())
config.network.kernel = parameters("push")[0].network.kernel
start_from("push", methods.params_like(methods.make(config, spec), spec), config)
"""
    done = run(program)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout == "milx: 47 of 50 parameters start from push; all others are drawn\n"


def test_the_check_and_success_in_a_world_need_none(tmp_path):
    rng = np.random.default_rng(0)
    with Writer(tmp_path / "set", None, 2, 2) as writer:
        for split in SPLITS:
            writer.add(split, split, [5, 5], [Demo(None, *rng.normal(size=(2, 5, 2))) for _ in range(2)])
    program = f"""
sys.path.insert(0, {str(pathlib.Path(__file__).parent / "worlds")!r})
import os
import numpy as np
from follower import WORLDS, follower_policy
from milx.data import check
from milx.types import Demo
from milx.worlds.evaluate import evaluate_in
from milx.worlds.slot import Task

check.main(["check", sys.argv[1]])
os.chdir(WORLDS)
task = Task("near/right", "near", (Demo(state=np.ones((6, 2)), action=np.zeros((6, 2))),))
outcomes = evaluate_in(follower_policy(), "point_world:make", [task], controls=["own"], episodes=2, workers=1)
print([outcome.end for outcome in outcomes])
"""
    done = run(program, tmp_path / "set")
    assert done.returncode == 0, done.stderr[-2000:]
    assert "3 tasks, 6 demonstrations" in " ".join(done.stdout.split())
    assert done.stdout.splitlines()[-1] == "[True, True]"


@pytest.mark.slow
def test_a_life_on_recorded_demonstrations_needs_none(tmp_path):
    """Imports, trains, evaluates, exports and loads, with the parameters of a life with MuJoCo."""
    failures.write_recording(tmp_path)
    for name in ("with", "without"):
        (tmp_path / name).mkdir()
    expected = failures.begin(tmp_path / "with")
    assert expected.code == 0, expected.errors[-2000:]
    program = f"""
sys.path.insert(0, {str(FAILURES)!r})
import pathlib
import failures
failures.live(pathlib.Path(sys.argv[1]), 0, "")
"""
    done = run(program, tmp_path / "without")
    assert done.returncode == 0, done.stderr[-2000:]
    assert json.loads(done.stdout.splitlines()[-1])["params"] == expected.result["params"]
