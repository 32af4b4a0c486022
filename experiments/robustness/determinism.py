"""Trains a short run again, killed and resumed, on more devices and on the CPU, and compares with the first time.

    python experiments/robustness/determinism.py

Says for each whether the parameters are the same bit for bit, and how far the losses are apart, relative to the first
run's. More devices are virtual ones where there is no accelerator.
"""

import itertools
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from typing import Any, NamedTuple

import jax
import numpy as np
from absl import app, flags, logging

import milx
from milx.core import files, pytrees
from milx.deploy import policy
from milx.evaluation import provenance
from milx.training.metrics import read_metrics

_OUT = flags.DEFINE_string("out", "experiments/results/robustness", "Folder of the JSON file.")
_ENVS = flags.DEFINE_list("envs", ["reach", "push"], "Environments.")
EVERY = 20
FLAGS = (
    *("--preset=cpu", "--config.data.tasks=64", "--config.data.demos_per_task=3", "--config.data.plan_batch=64"),
    *("--config.train.steps=200", f"--config.train.log_every={EVERY}", "--config.train.eval_every=100"),
    *("--config.evaluation.validation_tasks=8", "--config.evaluation.batch=8"),
)
PRECISIONS = {"float32": (), "bfloat16": ("--config.network.mixed_precision=true",)}


class Outcome(NamedTuple):
    """A hash of the best parameters, and the losses (20 updates apart)."""

    digest: str
    losses: np.ndarray


def train(command: list[str], workdir: pathlib.Path, environment: dict[str, str], kill_at: int | None) -> Outcome:
    """Trains; is killed when so many updates are written down, and started again."""
    environment = {**os.environ, **environment}
    script = "from milx import launch, runs\nlaunch.define_flags()\n"
    script += "launch.run(lambda config, folder: runs.make(config, folder).train())"
    command = [sys.executable, "-c", script, *command, f"--workdir={workdir}"]
    if kill_at is not None:
        process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while process.poll() is None and not any(line["step"] >= kill_at for line in metrics(workdir)):
            time.sleep(0.01)
        process.kill()
        process.wait()
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stdout[-1000:] + done.stderr[-1000:])
    digest = pytrees.fingerprint(policy.load_run(workdir).params)
    return Outcome(digest, np.array([line["loss"] for line in metrics(workdir) if "loss" in line]))


def metrics(workdir: pathlib.Path) -> list[dict[str, float]]:
    """Reads what the run has written down so far."""
    path = workdir / "metrics.jsonl"
    return read_metrics(path) if path.is_file() else []


def others() -> dict[str, tuple[dict[str, str], int | None]]:
    """Lists what is compared with the first run: environment variables, and when the run is killed."""
    found: dict[str, tuple[dict[str, str], int | None]] = {"again": ({}, None), "killed": ({}, 120)}
    if jax.default_backend() == "cpu":
        given = os.environ.get("XLA_FLAGS", "")
        for count in (2, 4):
            more = f"{given} --xla_force_host_platform_device_count={count}"
            found[f"{count} devices"] = {"XLA_FLAGS": more}, None
        return found
    for count in itertools.takewhile(lambda count: count <= jax.device_count(), (2, 4)):
        found[f"{count} devices"] = {"CUDA_VISIBLE_DEVICES": ",".join(map(str, range(count)))}, None
    return found | {"CPU": ({"JAX_PLATFORMS": "cpu"}, None)}


def main(_: list[str]) -> None:
    """Trains, compares, writes."""
    milx.configure()
    logging.set_verbosity(logging.ERROR)
    rows: list[dict[str, Any]] = []
    alone = {} if jax.default_backend() == "cpu" else {"CUDA_VISIBLE_DEVICES": "0"}
    folder = pathlib.Path(_OUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        for env, (precision, flag) in itertools.product(_ENVS.value, PRECISIONS.items()):
            command, first = [f"--env={env}", *FLAGS, *flag], pathlib.Path(name) / f"{env}-{precision}"
            expected = train(command, first, alone, None)
            for other, (environment, kill_at) in others().items():
                found = train(command, first.with_name(f"{first.name}-{other}"), alone | environment, kill_at)
                apart = np.abs(found.losses - expected.losses) / np.abs(expected.losses)
                row: dict[str, Any] = {"env": env, "precision": precision, "compared": other}
                row["same_parameters"] = found.digest == expected.digest
                row["losses_apart"] = {str(EVERY * (i + 1)): float(value) for i, value in enumerate(apart)}
                rows.append(row)
                print(json.dumps(row), flush=True)
                file = f"determinism{'-cpu' if jax.default_backend() == 'cpu' else ''}.json"
                files.write_json(folder / file, {"rows": rows} | provenance.origin())


if __name__ == "__main__":
    app.run(main)
