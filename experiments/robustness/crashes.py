"""Kills training at random moments, restarts it, and compares what comes out with an undisturbed run, bit for bit.

    python experiments/robustness/crashes.py            # 30 kills and 5 terminations, then the JSON file

The run learns from recorded demonstrations made up here, and writes a checkpoint every few tenths of a second, so that
many kills fall into the writing of one; every third kill waits for that. SIGTERM must end a run within 10 s, with exit
code 143 and a word on how to go on.
"""

import pathlib
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

import jax
import numpy as np
from absl import app, flags, logging
from rich.console import Console

from milx.config import assemble
from milx.core import files, pytrees
from milx.core.checkpoint import Checkpoints
from milx.data.dataset import Writer
from milx.deploy import policy
from milx.evaluation import provenance
from milx.training.recorded import RecordedRun
from milx.types import Demo

_KILLS = flags.DEFINE_integer("kills", 30, "SIGKILLs.", lower_bound=0)
_TERMS = flags.DEFINE_integer("terms", 5, "SIGTERMs.", lower_bound=0)
_OUT = flags.DEFINE_string("out", "experiments/results/robustness", "Folder of the JSON file.")
STEPS = 400
FLAGS = (
    *("--preset=cpu", f"--config.train.steps={STEPS}", "--config.train.log_every=5", "--config.train.eval_every=10"),
    *("--config.recorded.horizon=8", "--config.network.fc_layers=(40, 40)", "--config.train.meta_batch=4"),
    *("--config.network.filters=(4, 4)", "--config.network.strides=(2, 2)"),
)


def write_data(folder: pathlib.Path) -> None:
    """Writes a data set of noise: what is learned does not matter."""
    rng = np.random.default_rng(0)
    with Writer(folder, (12, 16), 3, 2, "crashes.py") as writer:
        for task in range(12):
            demos = [
                Demo(rng.integers(0, 256, (8, 12, 16, 3), np.uint8), rng.normal(size=(8, 3)), rng.normal(size=(8, 2)))
                for _ in range(3)
            ]
            writer.add(f"task {task}", "train" if task > 3 else "test" if task > 1 else "validation", [8] * 3, demos)


def start(data: pathlib.Path, workdir: pathlib.Path) -> subprocess.Popen:
    """Starts the launcher as a user does."""
    command = [sys.executable, "-m", "milx.train", f"--data={data}", f"--workdir={workdir}", *FLAGS]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def finish(data: pathlib.Path, workdir: pathlib.Path) -> str:
    """Runs to the end; a hash of the last checkpoint's parameters and optimizer, and of which one is the best."""
    process = start(data, workdir)
    out, _ = process.communicate()
    if process.returncode:
        raise RuntimeError(out[-2000:])
    run = RecordedRun(assemble.read(workdir / "config.json"), workdir, Console(quiet=True))
    checkpoints = Checkpoints(workdir / "checkpoints", read_only=True)
    params = policy.load_run(workdir).params
    trainer = jax.ShapeDtypeStruct((), np.int32), jax.eval_shape(run.trainer.optimizer.init, params)
    items, _ = checkpoints.restore(STEPS, {"params": params, "trainer": trainer})
    return pytrees.fingerprint({**items, "best": np.array(checkpoints.best)})


def writing(workdir: pathlib.Path, before: set[str]) -> bool:
    """Tells whether a checkpoint is being written; `before` is what earlier kills left of theirs."""
    return bool(unfinished(workdir) - before)


def unfinished(workdir: pathlib.Path) -> set[str]:
    """Lists checkpoints that are not complete."""
    checkpoints = workdir / "checkpoints"
    return {str(path) for pattern in ("*tmp*", "*/checksums.json.partial") for path in checkpoints.glob(pattern)}


def last_step(workdir: pathlib.Path) -> int:
    """Reads the step of the newest checkpoint."""
    steps = [int(path.name) for path in (workdir / "checkpoints").glob("*") if path.name.isdigit()]
    return max(steps, default=0)


def kill(data: pathlib.Path, workdir: pathlib.Path, rng: random.Random, in_write: bool, longest: float) -> dict:
    """Starts the run and kills it: at a random moment, or once a checkpoint is being written."""
    left, before = unfinished(workdir), last_step(workdir)
    process, began = start(data, workdir), time.monotonic()
    deadline = began + rng.uniform(0, longest)
    while process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.001)
    while in_write and process.poll() is None and not writing(workdir, left):
        time.sleep(0.0002)
    during = writing(workdir, left)
    alive = process.poll() is None
    process.kill()
    process.communicate()
    return {
        "killed": alive,
        "after_s": round(time.monotonic() - began, 2),
        "while_writing": during,
        "from_step": before,
        "to_step": last_step(workdir),
    }


def terminate(data: pathlib.Path, workdir: pathlib.Path, rng: random.Random, longest: float) -> dict:
    """Starts the run, sends SIGTERM at a random moment, and looks at how it ends."""
    process = start(data, workdir)
    time.sleep(rng.uniform(4, longest))  # after the imports, where nothing listens yet
    alive, began = process.poll() is None, time.monotonic()
    process.send_signal(signal.SIGTERM)
    out, _ = process.communicate()
    said = re.search(r"stopped(?: at step (\d+))?; the same command goes on", out)
    saved = said is None or said[1] is None or last_step(workdir) == int(said[1])  # before the first update: nothing
    found = {"sent": alive, "seconds": round(time.monotonic() - began, 2), "code": process.returncode}
    return found | {"said_how": said is not None, "saved": saved, "to_step": last_step(workdir)}


def main(_: list[str]) -> None:
    """Kills, compares, writes."""
    logging.set_verbosity(logging.WARNING)
    rng = random.Random(0)
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        write_data(folder / "data")
        finish(folder / "data", folder / "warm-up")  # fills the compilation cache
        began = time.monotonic()
        expected = finish(folder / "data", folder / "undisturbed")
        longest = time.monotonic() - began
        kills: list[dict[str, Any]] = []
        rounds = 0
        while len(kills) < _KILLS.value:
            rounds += 1
            workdir = folder / f"round-{rounds}"
            while len(kills) < _KILLS.value and last_step(workdir) < STEPS:
                found = kill(folder / "data", workdir, rng, len(kills) % 3 == 0, 0.7 * longest)
                if found["killed"]:
                    kills.append(found)
                    print(len(kills), found, flush=True)
            if finish(folder / "data", workdir) != expected:
                raise RuntimeError(f"round {rounds} ends with other parameters")
        terms: list[dict[str, Any]] = []
        while len(terms) < _TERMS.value:
            workdir = folder / f"term-{len(terms)}"
            shutil.rmtree(workdir, ignore_errors=True)  # of a run that had ended before the signal
            found = terminate(folder / "data", workdir, rng, 0.7 * longest)
            if found["sent"]:
                found["same"] = finish(folder / "data", workdir) == expected
                good = found["said_how"] and found["saved"] and found["same"]
                if found["seconds"] > 10 or found["code"] != 128 + signal.SIGTERM or not good:
                    raise RuntimeError(f"SIGTERM: {found}")
                terms.append(found)
                print(found, flush=True)
    same = {"rounds": rounds, "kills": len(kills), "while_writing": sum(found["while_writing"] for found in kills)}
    report = {"same_parameters": same, "undisturbed_s": round(longest, 1), "kills": kills, "terminations": terms}
    pathlib.Path(_OUT.value).mkdir(parents=True, exist_ok=True)
    files.write_json(pathlib.Path(_OUT.value) / "crashes-cpu.json", report | provenance.origin())
    print(same)


if __name__ == "__main__":
    app.run(main)
