"""What a run's programs take to be traced, lowered and compiled, from empty caches.

    python experiments/benchmarks/compiling.py --env=reach --preset=fast

A run with the sizes of the preset, but few tasks and updates: the training program repeats one update, whatever their
number. Programs are compiled while demonstrations are planned, so a run waits for less than the sum.
"""

import collections
import os
import pathlib
import tempfile

import jax
from absl import app, flags
from rich.console import Console

import milx
from milx.config.assemble import make_config
from milx.training.factory import make_run

_ENV = flags.DEFINE_string("env", "reach", "Environment.")
_PRESET = flags.DEFINE_string("preset", "fast", "Preset.")
_OUT = flags.DEFINE_string("out", None, "Folder of the JSON file; default experiments/results/benchmarks.")
_LONGEST = 8
"""Programs that are shown."""
PARTS = {
    "/jax/core/compile/jaxpr_trace_duration": "tracing",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lowering",
    "/jax/core/compile/backend_compile_duration": "compiling",
}
"""JAX's events, and what the table calls them."""


def main(_: list[str]) -> None:
    """Runs, and adds up what JAX reports."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        milx.configure()
        from common import RESULTS, Report  # uses JAX

        seconds: dict[str, dict[str, float]] = collections.defaultdict(lambda: dict.fromkeys(PARTS.values(), 0.0))

        def note(event: str, duration_secs: float, **about: str | int) -> None:
            if event in PARTS:
                name = str(about.get("fun_name")).removeprefix("jit(").removesuffix(")")
                seconds[name][PARTS[event]] += duration_secs

        jax.monitoring.register_event_duration_secs_listener(note)
        config = make_config(_ENV.value, preset=_PRESET.value)
        config.data.tasks = config.train.meta_batch
        config.train.steps = config.train.eval_every = config.train.log_every
        config.evaluation.validation_tasks = config.evaluation.batch = 4
        make_run(config, pathlib.Path(folder) / "run", Console(quiet=True)).train()
        report = Report("compiling", pathlib.Path(_OUT.value or RESULTS))
        for name in sorted(seconds, key=lambda name: -sum(seconds[name].values()))[:_LONGEST]:
            parts = ", ".join(f"{part} {seconds[name][part]:.2f} s" for part in PARTS.values())
            report.add(f"{_ENV.value} {_PRESET.value}, {name}", sum(seconds[name].values()), "s", note=parts)


if __name__ == "__main__":
    app.run(main)
