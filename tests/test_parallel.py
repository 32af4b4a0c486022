"""The same numbers on one device, on four, and on two hosts.

The devices are virtual ones of the CPU, and the hosts are processes that talk over loopback. They need XLA flags of
their own, so this file is also the program that the tests start (see `work`).
"""

import dataclasses
import json
import os
import pathlib
import re
import shutil
import socket
import subprocess
import sys

import numpy as np
import pytest

pytestmark = pytest.mark.slow
STEPS = 50


def random_demos(env, num_tasks, num_demos):
    """Samples wanderings that nobody planned: rendering and learning ask for no more."""
    import jax

    from milx.data import simulated as demos_lib

    rng = np.random.default_rng(0)
    like = demos_lib.shapes(env, num_tasks, num_demos)
    task = jax.vmap(env.sample_task, in_axes=(0, None))(jax.random.split(jax.random.key(1), num_tasks), "train")
    draw = lambda x: jax.numpy.asarray(0.2 * rng.standard_normal(x.shape), x.dtype)  # noqa: E731
    return dataclasses.replace(jax.tree.map(draw, like), task=task)


def measure(num_devices, everything):
    """Returns losses of 50 meta-updates on `num_devices` devices; if asked, also trials and planned actions."""
    import jax
    from jax.sharding import Mesh
    from tiny import tiny_config

    from milx import envs, methods
    from milx.core import parallel
    from milx.data.simulated import sampler
    from milx.evaluation import closed_loop
    from milx.methods.whitening import Whitening
    from milx.training.update import Trainer, make_optimizer
    from milx.trajopt.expert import Planned
    from milx.trajopt.ilqr import Options

    parallel.mesh = lambda: Mesh(jax.devices()[:num_devices], (parallel.AXIS,))
    config = tiny_config(env="reach_state")
    config.train.meta_batch = 4
    key = jax.random.key(2)

    def build(dtype):
        env = envs.make("reach_state")
        trainer = Trainer(
            sampler(env, config.train),
            methods.make(config, env.spec),
            config.train,
            make_optimizer(config.optimizer, STEPS),
        )
        sizes = env.state_size, env.action_size
        flat = Whitening(*(np.full(n, v, dtype) for n in sizes for v in (0, 1)))
        demos = jax.tree.map(lambda x: x.astype(dtype) if x.dtype.kind == "f" else x, random_demos(env, 5, 2))
        return env, trainer, demos, trainer.init(key, flat)

    # In float32 rounding, which is another for each number of devices, now and then turns a pixel at an edge over.
    with jax.enable_x64(True):
        env, trainer, demos, state = build(np.float64)
        after, metrics = jax.jit(
            lambda state, demos: jax.lax.scan(lambda s, _: trainer.update(s, demos, key), state, length=STEPS)
        )(state, demos)
    found = {"losses": np.asarray(metrics["loss"]).tolist(), "step": int(after.step)}
    if everything:
        env, trainer, demos, state = build(np.float32)
        config.evaluation.batch = config.evaluation.trials = 3
        trials = closed_loop.run_trials(env, trainer.method, state.params, demos, config.evaluation, key)
        found["trials"] = np.asarray(trials.states.qpos).tolist()
        start = jax.tree.map(lambda x: x[:4, 0, 0], demos.states)
        task = jax.tree.map(lambda x: x[:4], demos.task)
        _, action = Planned(Options(iterations=2)).perform(env, task, start, jax.random.split(key, 4), 0.01)
        found["action"] = np.asarray(action).tolist()
    return found


def write_data(folder):
    """Writes a recorded data set of noise, for a run that needs no planner."""
    from milx.data.dataset import Writer
    from milx.types import Demo

    rng = np.random.default_rng(0)
    with Writer(folder, None, 6, 2) as writer:
        for task in range(8):
            demos = [Demo(None, rng.normal(size=(9, 6)), rng.normal(size=(9, 2))) for _ in range(3)]
            writer.add(f"task {task}", ("test", "validation", *["train"] * 6)[task], [9] * 3, demos)


def run(data, folder):
    """Trains and validates on recorded demonstrations, on all devices that there are."""
    from tiny import QUIET

    from milx.training import recorded

    config = recorded.config_for(data, preset="cpu")
    config.recorded.horizon, config.network.fc_layers = 9, (32,)
    config.train.steps, config.train.log_every, config.train.eval_every = 40, 10, 20
    run = recorded.RecordedRun(config, folder, QUIET)
    run.train()
    return {
        "metrics": [json.loads(line) for line in (run.folder / "metrics.jsonl").open()],
        "params": params_of(folder),
    }


def params_of(folder):
    """Restores the parameters of a run on all devices that there are, as one list of numbers."""
    import jax

    import milx

    leaves = jax.tree.leaves(milx.load(folder).params)
    return [float(x) for leaf in leaves for x in np.ravel(leaf)]


def work(arguments):
    """Runs in a process of its own: `devices 1,4 FOLDER`, `alone DATA FOLDER`, or `host ID ADDRESS DATA FOLDER`."""
    import milx

    milx.configure()
    if arguments[0] == "devices":
        found = {n: measure(int(n), everything=True) for n in arguments[1].split(",")}
        return found | {"restored": params_of(arguments[2])}
    if arguments[0] == "alone":
        return run(*arguments[1:])
    from milx.core import parallel

    parallel.join_hosts(arguments[2], 2, int(arguments[1]))
    return run(*arguments[3:]) | measure(2, False)


def start(num_devices, *arguments, **environment):
    flags = re.sub(r"--xla_force_host_platform_device_count=\S+", "", os.environ.get("XLA_FLAGS", ""))
    flags += f" --xla_force_host_platform_device_count={num_devices}"
    env = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", **environment}
    return subprocess.Popen(
        [sys.executable, __file__, *map(str, arguments)],
        env=env,
        cwd=pathlib.Path(__file__).parent,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def answer(process):
    out, err = process.communicate(timeout=900)
    assert process.returncode == 0, err[-3000:]
    return json.loads(out.splitlines()[-1])


@pytest.fixture(scope="module")
def data(cache, tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "set"
    write_data(folder)
    return folder


@pytest.fixture(scope="module")
def devices(alone):
    return answer(start(4, "devices", "1,4", alone["folder"]))


@pytest.fixture(scope="module")
def hosts(data, tmp_path_factory):
    """Runs two processes that make one run together."""
    folder = tmp_path_factory.mktemp("hosts")
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    both = [start(1, "host", i, address, data, folder / "run") for i in range(2)]
    return [answer(process) | {"folder": folder / "run"} for process in both]


@pytest.fixture(scope="module")
def alone(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("alone") / "run"
    return answer(start(1, "alone", data, folder)) | {"folder": folder}


def test_losses_of_fifty_updates_do_not_depend_on_the_number_of_devices(devices):
    one, many = devices["1"], devices["4"]
    assert one["step"] == many["step"] == STEPS
    assert len(set(one["losses"])) == STEPS, "every batch is another one"
    np.testing.assert_allclose(many["losses"], one["losses"], rtol=1e-9)


def test_demonstrations_and_trials_do_not_depend_on_the_number_of_devices(devices):
    for name in ("trials", "action"):
        np.testing.assert_allclose(devices["4"][name], devices["1"][name], rtol=1e-5, atol=1e-4)
        assert np.std(devices["1"][name]) > 1e-3


def test_a_checkpoint_of_one_device_is_restored_on_four(alone, devices):
    assert len(set(alone["params"])) > 300
    assert devices["restored"] == alone["params"]


def test_a_checkpoint_of_two_hosts_is_restored_on_one_device(hosts, tmp_path):
    assert params_of(hosts[0]["folder"]) == hosts[0]["params"]
    copy = shutil.copytree(hosts[0]["folder"], tmp_path / "run")
    (checksums,) = (copy / "checkpoints" / "40").glob("checksums.json")
    checksums.unlink()  # then every array is read before it is trusted
    assert params_of(copy) == hosts[0]["params"]


def test_two_hosts_have_the_losses_of_one_device(devices, hosts):
    for host in hosts:
        np.testing.assert_allclose(host["losses"], devices["1"]["losses"], rtol=1e-9)


def test_two_hosts_train_and_validate_as_one_host_does(hosts, alone):
    for host in hosts:
        assert len(host["metrics"]) == len(alone["metrics"])
        for line, expected in zip(host["metrics"], alone["metrics"], strict=True):
            assert line["step"] == expected["step"]
            for name in set(expected) - {"step", "steps_per_s"}:
                np.testing.assert_allclose(line[name], expected[name], rtol=2e-4)


if __name__ == "__main__":
    print(json.dumps(work(sys.argv[1:])))
