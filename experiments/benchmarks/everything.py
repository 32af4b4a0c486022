"""Runs all benchmarks, several times each, in processes of their own, and writes their page and chart.

    python experiments/benchmarks/everything.py
    python experiments/benchmarks/everything.py --only=physics --only=render --runs=5
    python experiments/benchmarks/everything.py --only=meshes --mjcf=panda/robot.xml

The result files hold the median of the runs and the value of every run, and are written again after each run, so that
nothing is lost if a later one fails. `meshes` needs files of models, and is left out without them; on a CPU so is what
takes too long there.
"""

import json
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

from absl import app, flags

ON_CPUS = ("meta_step", "few_shot", "physics", "render", "latency", "deploy", "main_command")
"""The scripts that a CPU runs, too."""
BENCHMARKS = (*ON_CPUS, "meshes", "planning", "growth", "scaling", "compiling")
"""The scripts."""
HERE = pathlib.Path(__file__).parent
RESULTS = HERE.parent / "results" / "benchmarks"


def merged(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Merges the files of several runs of one benchmark.

    Returns:
        what the last one holds, with the median of each row over the runs that have one, the most memory, and under
        "runs" the value of every run, None where there was none.
    """
    rows = {row["name"]: row for run in runs for row in run["rows"]}
    found = [{row["name"]: row for row in run["rows"]} for run in runs]
    for name, row in rows.items():
        values = [run[name]["median"] if name in run else None for run in found]
        memories = [run[name]["peak_memory_gib"] for run in found if name in run]
        measured = [value for value in values if value is not None]
        memory = max((memory for memory in memories if memory is not None), default=None)
        median = statistics.median(measured) if measured else None
        rows[name] = row | {"median": median, "peak_memory_gib": memory, "runs": values}
    return runs[-1] | {"rows": list(rows.values())}


def run(name: str, arguments: list[str], folders: list[pathlib.Path], out: pathlib.Path) -> bool:
    """Runs a benchmark into the last folder, merges what all folders hold into `out`, and tells if it worked."""
    began = time.perf_counter()
    done = subprocess.run([sys.executable, str(HERE / f"{name}.py"), f"--out={folders[-1]}", *arguments])
    print(f"{name}, run {len(folders)}: {time.perf_counter() - began:.0f} s, exit code {done.returncode}", flush=True)
    out.mkdir(parents=True, exist_ok=True)
    for path in folders[-1].glob("*.json"):
        files = [folder / path.name for folder in folders]
        merge = merged([json.loads(file.read_text()) for file in files if file.is_file()])
        (out / path.name).write_text(json.dumps(merge, indent=1) + "\n")
    return not done.returncode


def _all() -> tuple[str, ...]:
    """Lists what runs here; JAX is asked in another process, so that this one takes no memory of the accelerator."""
    ask = [sys.executable, "-c", "import jax; print(jax.default_backend())"]
    return ON_CPUS if subprocess.check_output(ask, text=True).strip() == "cpu" else BENCHMARKS


def main(_: list[str]) -> None:
    """Runs what was chosen, and says what failed."""
    failed = []
    names = [name for name in _ONLY.value or _all() if name != "meshes" or _MJCF.value]
    with tempfile.TemporaryDirectory() as folder:
        folders = {name: [pathlib.Path(folder, name, str(i)) for i in range(_RUNS.value)] for name in names}
        for count in range(1, _RUNS.value + 1):
            for name in names:
                arguments = [f"--mjcf={path}" for path in _MJCF.value or () if name == "meshes"]
                if not run(name, arguments, folders[name][:count], pathlib.Path(_OUT.value)):
                    failed.append(f"{name}, run {count}")
    if _OUT.value == str(RESULTS):
        subprocess.run(
            [sys.executable, str(HERE / "summary.py"), str(HERE.parents[1] / "docs/benchmarks.png")], check=True
        )
        subprocess.run([sys.executable, str(HERE.parent / "paper" / "pages.py")], check=True)
    if failed:
        sys.exit(f"everything: failed: {', '.join(failed)}")


if __name__ == "__main__":
    _OUT = flags.DEFINE_string("out", str(RESULTS), "Folder of the JSON files; the page is written for the default.")
    _ONLY = flags.DEFINE_multi_enum("only", None, list(BENCHMARKS), "Which; default all (repeat the flag).")
    _RUNS = flags.DEFINE_integer("runs", 3, "How often each is run.", lower_bound=1)
    _MJCF = flags.DEFINE_multi_string("mjcf", None, "Files of models for `meshes` (repeat the flag).")
    app.run(main)
