"""How a meta-step's time and memory grow: with the meta-batch, the horizon, the image and the inner steps.

    python experiments/benchmarks/growth.py

The paper's reach network, rendering included; one size changes at a time from 5 tasks, 50 time steps, 64 rows of 80
pixels and 1 inner step.
"""

import functools
import pathlib

import common
import workload
from absl import app, flags

import milx
from milx import envs
from milx.config.assemble import make_config
from milx.methods.mil import MILConfig
from milx.networks.policy_network import PolicyConfig

_OUT = flags.DEFINE_string("out", str(common.RESULTS), "Folder of the JSON file.")
_TINY = flags.DEFINE_bool("tiny", False, "One size of each, for a try.")
_SIZES = {
    "meta-batch": (15, 40, 100),
    "time steps": (10, 25),
    "image rows": (32, 128),
    "inner steps": (3, 5),
}


def main(_: list[str]) -> None:
    """Measures and writes the JSON file."""
    milx.configure()
    report = common.Report("growth", pathlib.Path(_OUT.value))
    changes = [(name, size) for name, sizes in _SIZES.items() for size in sizes[: 1 if _TINY.value else None]]
    for name, size in [("meta-batch", 5), *changes]:
        config = make_config("reach", preset="paper")
        assert isinstance(config.method, MILConfig) and isinstance(config.network, PolicyConfig)
        config.train.meta_batch, config.method.imitation_steps = 5, 0
        config.network.mixed_precision = common.accelerated()
        frames = size if name == "time steps" else config.train.support_frames
        config.train.support_frames = config.train.query_frames = frames
        config.train.meta_batch = size if name == "meta-batch" else config.train.meta_batch
        config.method.inner_steps = size if name == "inner steps" else config.method.inner_steps
        rows = size if name == "image rows" else config.env.image_shape[0]
        config.env.image_shape = (rows, rows * 5 // 4)
        report.measure(
            f"{name} {size}",
            "ms",
            functools.partial(workload.measure_step, config, envs.make("reach", config.env.image_shape)),
        )


if __name__ == "__main__":
    app.run(main)
