"""The command line: help, and bad input that ends with a message instead of a traceback."""

import importlib
import json
import multiprocessing
import os
import pathlib
import re
import runpy
import signal
import subprocess
import sys
import time
import types

import pytest
from absl import flags

from milx.config import assemble
from milx.config.assemble import make_config
from milx.data import RECORDED
from milx.training import command_line


def main(folder, arguments):
    """Does in this process what `python -m milx.train` does in a new one, with its output in files."""
    os.chdir(folder)
    for stream, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(f"{folder}.{name}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
    sys.argv = ["milx.train", *arguments]
    runpy.run_module("milx.train", run_name="__main__", alter_sys=True)


@pytest.fixture(scope="module")
def forks():
    """Imports milx once, in a process of which those that run the command line are forks."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["milx.training.factory"])
    return context


@pytest.fixture
def train(forks, tmp_path):
    """Returns a function that runs the command line in `tmp_path`."""

    def run(*arguments):
        process = forks.Process(target=main, args=(tmp_path, arguments))
        process.start()
        process.join(120)
        stdout, stderr = (pathlib.Path(f"{tmp_path}.{name}").read_text() for name in ("stdout", "stderr"))
        return types.SimpleNamespace(returncode=process.exitcode, stdout=stdout, stderr=stderr)

    return run


@pytest.mark.parametrize(
    ("argument", "message", "valid"),
    [
        ("--env=nope", "env: got 'nope'", ["reach"]),
        ("--preset=nope", "preset: got 'nope'", ["paper", "fast", "cpu"]),
        ("--config.network.context=7", "--config.network.context: no such field with --method=mil", ["network.heads"]),
        ("--config.train.nope=1", "--config.train.nope: no such field", ["train.steps", "method.inner_lr", "seed"]),
    ],
)
def test_bad_input_ends_with_a_message_that_lists_what_is_valid(train, tmp_path, argument, message, valid):
    process = train(argument)
    said = process.stdout + process.stderr
    assert process.returncode != 0
    assert message in said
    assert "Traceback" not in said
    listed = re.split(r"[,\s]+", said.split("expected one of")[1])
    assert set(valid) <= set(listed)
    assert list(tmp_path.iterdir()) == [], "no run was begun"


@pytest.mark.parametrize(
    ("argument", "message"),
    [
        ("--config.recorded.horizon=7", "--config.recorded.horizon: expected only with --data"),
        ("--env=recorded", "--env: got 'recorded', expected --data=FOLDER"),
        (
            "--num_processes=2",
            "--coordinator, --num_processes and --process_id: got some of them, expected all or none",
        ),
    ],
)
def test_flags_that_do_not_belong_together_end_with_a_message(train, argument, message):
    process = train(argument)
    assert process.returncode != 0
    assert message in process.stderr and "Traceback" not in process.stderr


@pytest.mark.slow
def test_the_first_line_says_what_is_done_and_how_long_it_took(train, tmp_path):
    (tmp_path / "run").write_text("a file, so that no run begins")
    said = train("--env=reach", "--preset=cpu", "--seed=3", "--workdir=run").stdout.splitlines()[0]
    assert re.match(
        r"milx: mil on reach, preset cpu, seed 3, with \d+ CPU cores, in run\. This took [\d.]+ minutes on", said
    )
    said = train("--method=lstm", "--workdir=run").stdout
    assert said.startswith("milx: lstm on reach, preset cpu, seed 0") and "--preset=paper, --preset=fast" in said
    assert "This took" not in said, "that was measured for MIL"


def test_a_device_without_a_preset_is_told_which_there_are(train):
    said = train("--env=grasp").stderr
    assert "--preset: got none, expected one of paper, fast: grasp has none for this device" in said


def test_a_method_has_no_settings_of_another(train):
    said = train("--method=lstm", "--config.method.inner_steps=7").stderr
    assert "--config.method.inner_steps: no such field with --method=lstm, expected one of" in said
    assert "method.given" in said and "network.context_frames" in said and "network.heads" not in said
    said = train("--env=reach_state", "--method=lstm_attention", "--config.network.filters=(4,)").stderr
    assert "--config.network.filters: no such field with --method=lstm_attention, expected one of" in said
    assert "network.fc_layers" in said and "network.kernel" not in said


@pytest.mark.slow
def test_a_package_of_ones_own_is_found(tmp_path, monkeypatch):
    """Installs a distribution that names its module as a plugin: its environment and its method have flags."""
    (tmp_path / "mine.py").write_text(
        "import milx\n"
        "from milx.envs.reach.env import ReachState\n"
        "from milx.envs.reach.presets import REACH_STATE\n"
        "class Mine(ReachState):\n"
        "    name = 'my_env'\n"
        "milx.register_env(Mine, REACH_STATE)\n"
        "milx.register_method('my_method', make=None)\n"
    )
    info = tmp_path / "mine-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[milx.plugins]\nmine = mine\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    def train(*arguments):
        command = [sys.executable, "-m", "milx.train", *arguments]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)

    said = train("--env=my_env", "--method=my_method", "--config.train.nope=1").stderr
    assert "--config.train.nope: no such field with --method=my_method" in said

    (tmp_path / "mine.py").write_text("import milx\nmilx.no_such_function()\n")
    said = train("--env=nope").stderr
    assert "plugin mine = mine: AttributeError" in said, "a broken package is named"
    assert "env: got 'nope'" in said, "and milx goes on without it"


def test_flags_of_trials_are_refused_with_recorded_data():
    config = make_config(RECORDED, preset="cpu")
    command_line._check_fields(["milx.train", "--config.evaluation.shots=2"], config)
    given = ["--config.evaluation.gym=a:b", "--config.evaluation.trials=2", "--config.evaluation.gym_workers=2"]
    command_line._check_fields(["milx.train", *given], config)
    with pytest.raises(flags.Error, match=r"--config.evaluation.trials: expected only without --data"):
        command_line._check_fields(["milx.train", *given[1:]], config)
    with pytest.raises(flags.Error, match=r"--config.evaluation.gym: expected only with --data; nothing reads it here"):
        command_line._check_fields(["milx.train", "--config.evaluation.gym=a:b"], make_config("reach", preset="cpu"))
    for name in ("evaluation.batch", "train.redraw", "env.image_shape"):
        with pytest.raises(flags.Error, match=f"--config.{name}: expected only without --data; nothing reads it here"):
            command_line._check_fields(["milx.train", f"--config.{name}=7"], config)


def test_value_of_another_type_ends_with_a_message(train):
    process = train("--config.train.steps=many")
    said = process.stdout + process.stderr
    assert process.returncode != 0
    assert "Traceback" not in said
    assert "train.steps" in said and "many" in said


def test_help_shows_the_flags_and_their_choices(train):
    said = train("--help").stdout
    for flag in ("env", "method", "preset", "seed", "workdir"):
        assert re.search(rf"^\s*--(\[no\])?{flag}:", said, re.MULTILINE), flag
    assert "--config.path.to.field=value" in re.sub(r"\s+", "", said)
    assert "meta-trains a policy on them, and evaluates it" in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"SLURM_STEP_NUM_TASKS": "many"}, "SLURM_STEP_NUM_TASKS: got 'many', expected a number, as SLURM sets it"),
        ({"SLURM_STEP_NUM_TASKS": "2", "SLURM_JOB_ID": "x"}, "hosts: cannot be joined, expected addresses that answer"),
        ({"JAX_PLATFORMS": "cuda"}, "JAX_PLATFORMS: got 'cuda', expected a platform with a device"),
        ({"JAX_PLATFORMS": "nope"}, "JAX_PLATFORMS: got 'nope', expected a platform with a device"),
    ],
    ids=lambda value: next(iter(value), None) if isinstance(value, dict) else None,
)
def test_an_odd_environment_ends_with_a_message(tmp_path, variables, message):
    cleaned = {name: value for name, value in os.environ.items() if not name.startswith(("SLURM", "JAX_PLATFORMS"))}
    command = [sys.executable, "-m", "milx.train", "--workdir=run"]
    done = subprocess.run(
        command, cwd=tmp_path, env=cleaned | variables, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert message in done.stderr.splitlines()[-1]
    assert not (tmp_path / "run").exists()


def stopped(name, function, arguments):
    """Calls `main` of a launcher that gets SIGTERM when it calls one of its functions."""

    def wait(*_):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)

    module = importlib.import_module(name)
    setattr(module, function, wait)
    if function in ("LeRobot", "Robomimic"):
        module.command_line.define_flags(state="", action="", task="")
    flags.FLAGS(["milx", *(argument for argument in arguments if argument.startswith("--"))])
    module.main(["milx", *(argument for argument in arguments if not argument.startswith("--"))])


def evaluated(errors, *arguments):
    """Calls `main` of the launcher that evaluates, and writes what it says of errors to a file."""
    module = importlib.import_module("milx.evaluate")
    sys.stderr = errors.open("w")  # to which Python writes the last words of a process, too
    module.main(flags.FLAGS(["milx.evaluate", *arguments]))


def test_another_data_set_is_tried_in_a_world_only(forks, tmp_path):
    process = forks.Process(target=evaluated, args=(tmp_path / "errors", "run", "--data=later"))
    process.start()
    process.join(60)
    assert process.exitcode == 1
    assert "data: got 'later' without --gym, expected the world" in (tmp_path / "errors").read_text()


@pytest.mark.parametrize(
    ("name", "function", "arguments"),
    [
        ("milx.evaluate", "make_run", ["run"]),
        ("milx.export", "load", ["run", "out"]),
        ("milx.data.check", "DataSet", ["set"]),
        ("milx.data.robomimic", "Robomimic", ["file", "out"]),
        ("milx.data.lerobot", "LeRobot", ["folder", "out"]),
    ],
)
def test_every_launcher_ends_by_a_signal_with_its_exit_code(forks, tmp_path, monkeypatch, name, function, arguments):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.json").write_text(json.dumps(assemble.to_dict(make_config("reach_state"))))
    process = forks.Process(target=stopped, args=(name, function, arguments))
    process.start()
    process.join(60)
    assert process.exitcode == 143
