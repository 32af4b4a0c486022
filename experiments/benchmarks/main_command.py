"""README's main command from a fresh process with empty caches, and once more with full ones, beside an older commit.

    python experiments/benchmarks/main_command.py --peers=9087752 --env=reach

Each commit runs from a checkout of its own, in the environment that runs this script. The ratio counts: hosts differ by
a factor of two.
"""

import json
import math
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from typing import Any, NamedTuple

from absl import app, flags
from common import RESULTS, Report

_PEERS = flags.DEFINE_list("peers", [], "Commits to compare with; the checkout's own runs first.")
_ENV = flags.DEFINE_string("env", "reach", "Environment, with the preset cpu.")
_OUT = flags.DEFINE_string("out", str(RESULTS), "Folder of the JSON file.")
ROOT = pathlib.Path(__file__).parents[2]


class Times(NamedTuple):
    """What a process took.

    Attributes:
        seconds: until its end.
        first: seconds until the first line of metrics.
        gib: its peak of resident memory.
    """

    seconds: float
    first: float
    gib: float


def run(source: pathlib.Path, workdir: pathlib.Path, cache: pathlib.Path, to_the_end: bool = True) -> Times:
    """Runs the command, to the end or only until the first metrics."""
    environment = {**os.environ, "PYTHONPATH": str(source), "XDG_CACHE_HOME": str(cache)}
    command = [sys.executable, "-m", "milx.train", f"--env={_ENV.value}", "--preset=cpu", f"--workdir={workdir}"]
    began, first, metrics = time.perf_counter(), float("nan"), workdir / "metrics.jsonl"
    silent = subprocess.DEVNULL
    # `-m` looks for the package in `cwd` first.
    process = subprocess.Popen(command, env=environment, cwd=source, stdout=silent, stderr=silent)
    while not (ended := os.wait4(process.pid, os.WNOHANG))[0]:
        if math.isnan(first) and metrics.is_file() and metrics.stat().st_size:
            first = time.perf_counter() - began
            if not to_the_end:
                process.kill()
        time.sleep(0.05)
    _, status, usage = ended
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode and (to_the_end or math.isnan(first)):
        raise RuntimeError(f"{source}: {' '.join(command)} ended with {process.returncode}")
    return Times(time.perf_counter() - began, first, usage.ru_maxrss / 2**20)


def measure(commit: str, folder: pathlib.Path, report: Report) -> None:
    """Adds the rows of one commit."""
    source = folder / commit
    subprocess.run(["git", "worktree", "add", "--detach", "--quiet", str(source), commit], cwd=ROOT, check=True)
    try:
        times = run(source, folder / f"{commit}-run", folder / f"{commit}-cache")
        again = run(source, folder / f"{commit}-again", folder / f"{commit}-cache", to_the_end=False)
    finally:
        subprocess.run(["git", "worktree", "remove", "--force", str(source)], cwd=ROOT, check=True)
    result: dict[str, Any] = json.loads((folder / f"{commit}-run" / "evaluation.json").read_text())
    parts = ", ".join(f"{name} {value:.0f} s" for name, value in result["wall_clock_s"].items() if name != "total")
    report.add(f"{_ENV.value}, {commit}", times.seconds, "s", times.gib, f"success {result['success']:.1%}; {parts}")
    report.add(f"{_ENV.value}, {commit}, until the first metrics", times.first, "s")
    report.add(f"{_ENV.value}, {commit}, until the first metrics of a second run", again.first, "s")


def main(_: list[str]) -> None:
    """Measures this commit and its peers, one after the other."""
    own = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True)
    report = Report("main_command", pathlib.Path(_OUT.value))
    with tempfile.TemporaryDirectory() as folder:
        for commit in (own.stdout.strip(), *_PEERS.value):
            measure(commit, pathlib.Path(folder), report)


if __name__ == "__main__":
    app.run(main)
