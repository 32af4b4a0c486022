"""Weak scaling: the push-sized meta-step, rendering included, with 15 tasks on each of 1, 2, 4, ... devices.

    python experiments/benchmarks/scaling.py

The step on n devices does n times the work; an efficiency of 1 means that it takes no longer than on one.
"""

import pathlib

import common
import jax
import push_sized
import workload
from absl import app, flags
from jax.sharding import Mesh

import milx
from milx.core import parallel
from milx.networks.policy_network import PolicyConfig

_OUT = flags.DEFINE_string("out", str(common.RESULTS), "Folder of the JSON file.")
_TASKS = flags.DEFINE_integer("tasks", 15, "Tasks on each device.")
_FRAMES = flags.DEFINE_integer("frames", None, "Time steps of a demonstration; all by default.")


def measure(devices: int) -> tuple[float, float]:
    """Measures the median ms of a step in a scan on so many devices, and GiB on each."""
    mesh = Mesh(jax.devices()[:devices], (parallel.AXIS,))
    parallel.mesh = lambda: mesh  # type: ignore[assignment]
    frames = _FRAMES.value
    config = push_sized.config(meta_batch=devices * _TASKS.value, support_frames=frames, query_frames=frames)
    assert isinstance(config.network, PolicyConfig)
    config.network.mixed_precision = common.accelerated()
    return workload.measure_step(config, push_sized.PushSized())


def main(_: list[str]) -> None:
    """Measures and writes the JSON file."""
    milx.configure()
    report = common.Report("scaling", pathlib.Path(_OUT.value))
    devices, alone = 1, None
    while devices <= jax.device_count():
        milliseconds, memory = measure(devices)
        alone = alone or milliseconds
        report.add(f"{devices} devices", milliseconds, "ms", memory, f"{_TASKS.value} tasks each")
        report.add(f"{devices} devices, efficiency", alone / milliseconds, "")
        devices *= 2


if __name__ == "__main__":
    app.run(main)
