"""Runs all benchmarks, several times each, in processes of their own, and writes their page and chart.

    python experiments/benchmarks/everything.py
    python experiments/benchmarks/everything.py --only=physics --only=render --runs=5
    python experiments/benchmarks/everything.py --only=meshes --mjcf=panda/robot.xml

The result files hold the median of the runs that worked and the value of each, and are written again after every run,
so that nothing is lost if a later one fails. `meshes` needs files of models, and is left out without them; on a CPU so
is what takes too long there.
"""

import itertools
import json
import os
import pathlib
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

from absl import app, flags

from milx.evaluation import provenance

ON_CPUS = ("meta_step", "few_shot", "physics", "render", "latency", "deploy", "main_command")
"""The scripts that a CPU runs, too."""
BENCHMARKS = (*ON_CPUS, "convolutions", "meshes", "planning", "growth", "scaling", "compiling")
"""The scripts."""
HERE = pathlib.Path(__file__).parent
RESULTS = HERE.parent / "results" / "benchmarks"
FLAGS = flags.FLAGS


def define_flags(values: flags.FlagValues = FLAGS) -> None:
    """Defines --out, --only, --runs and --mjcf."""
    where = "Folder of the JSON files; the page is written for the default."
    flags.DEFINE_string("out", str(RESULTS), where, flag_values=values)
    which = "Which; default all (repeat the flag)."
    flags.DEFINE_multi_enum("only", None, list(BENCHMARKS), which, flag_values=values)
    flags.DEFINE_integer("runs", 3, "How often each is run.", lower_bound=1, flag_values=values)
    models = "Files of models for `meshes` (repeat the flag)."
    flags.DEFINE_multi_string("mjcf", None, models, flag_values=values)


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


def run(name: str, arguments: list[str], folder: pathlib.Path, commit: str | None) -> bool:
    """Runs a benchmark of a commit, which writes its files to a folder, and tells whether it worked."""
    began, environment = time.perf_counter(), os.environ | ({} if commit is None else {"MILX_COMMIT": commit})
    command = [sys.executable, str(HERE / f"{name}.py"), f"--out={folder}", *arguments]
    done = subprocess.run(command, env=environment)
    print(f"{name}: {time.perf_counter() - began:.0f} s, exit code {done.returncode}", flush=True)
    return not done.returncode


def merge(folders: list[pathlib.Path], out: pathlib.Path) -> None:
    """Merges the files of the same name in several folders."""
    out.mkdir(parents=True, exist_ok=True)
    for name in sorted({path.name for folder in folders for path in folder.glob("*.json")}):
        files = [folder / name for folder in folders]
        content = merged([json.loads(file.read_text()) for file in files if file.is_file()])
        (out / name).write_text(json.dumps(content, indent=1) + "\n")


def _all() -> tuple[str, ...]:
    """Lists what runs here; JAX is asked in another process, so that this one takes no memory of the accelerator."""
    ask = [sys.executable, "-c", "import jax; print(jax.default_backend())"]
    return ON_CPUS if subprocess.check_output(ask, text=True).strip() == "cpu" else BENCHMARKS


def main(_: list[str]) -> None:
    """Runs what was chosen, and says what failed."""
    out, failed = pathlib.Path(FLAGS.out).resolve(), []
    commit = provenance.commit()  # later runs find a tree that the files of earlier ones have changed
    if "meshes" in (FLAGS.only or ()) and not FLAGS.mjcf:
        raise app.UsageError("--only=meshes: expected --mjcf, the files of models")
    names = [name for name in FLAGS.only or _all() if name != "meshes" or FLAGS.mjcf]
    worked: dict[str, list[pathlib.Path]] = {name: [] for name in names}
    with tempfile.TemporaryDirectory() as folder:
        for number, name in itertools.product(range(FLAGS.runs), names):
            arguments = [f"--mjcf={path}" for path in FLAGS.mjcf or () if name == "meshes"]
            here = pathlib.Path(folder, name, str(number))
            if run(name, arguments, here, commit):
                worked[name].append(here)
                merge(worked[name], out)
            else:
                failed.append(f"{name}, run {number + 1}")
    if out == RESULTS.resolve():
        chart = HERE.parents[1] / "docs" / "benchmarks.png"
        subprocess.run([sys.executable, str(HERE / "summary.py"), str(chart)], check=True)
        subprocess.run([sys.executable, str(HERE.parent / "paper" / "pages.py")], check=True)
    if failed:
        sys.exit(f"everything: failed: {', '.join(failed)}")


if __name__ == "__main__":
    define_flags()
    app.run(main)
