"""Lets every file operation of a tiny life fail, one after the other: the disk, the process, or somebody's patience.

    python experiments/robustness/failures.py                   # each operation once, the kinds of failure in turn
    python experiments/robustness/failures.py --every=1 --kinds=SIGKILL
    python experiments/robustness/failures.py --calls --every=7    # every seventh call to the C library
    python experiments/robustness/failures.py --planning           # lives that plan demonstrations

A life imports demonstrations, trains, validates and writes checkpoints, evaluates, exports and loads. With `--planning`
it plans demonstrations and keeps them instead, and their fingerprint stands for that of the parameters. In a process of
its own it is disturbed once, at the n-th operation on a file that Python makes in its folder: opening, synchronizing,
locking, renaming, removing, or making a folder. With `--calls` it is the n-th call to the C library that touches a
file there, reading and writing included, also of TensorStore, HDF5 and Arrow (Linux, with a C compiler). It has to end
within the deadline, with the right exit code and a message; what it has left must be whole; and the same life, begun
again, must end with the parameters of the one that was not disturbed.
"""

import concurrent.futures
import contextlib
import ctypes
import errno
import fcntl
import itertools
import json
import os
import pathlib
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import h5py
import numpy as np
from absl import app, flags, logging

KINDS = ("ENOSPC", "SIGKILL", "EIO", "SIGTERM", "full", "SIGINT", "SIGHUP")
CALL_KINDS = ("EIO", "SIGKILL", "short", "ENOSPC", "SIGTERM")
"""What can happen to a call to the C library; "short" reads or writes half of the bytes."""
FLAGS = flags.FLAGS
DEADLINE = 120
"""Seconds in which a life must have ended, disturbed or not."""
_EVENTS = {"open": 0, "os.rename": 0, "os.mkdir": 0, "os.remove": 0, "os.rmdir": 0, "os.truncate": 0, "os.link": 0}
"""Python's audit events of operations on files, and which of their arguments is the path."""


def write_recording(path: pathlib.Path) -> None:
    """Writes 12 demonstrations of 6 tasks in robomimic's layout, and the names of their tasks."""
    rng = np.random.default_rng(0)
    with h5py.File(path / "demos.hdf5", "w") as file:
        for number in range(12):
            group = file.create_group(f"data/demo_{number}")
            group["obs/robot"] = rng.normal(size=(6, 3))
            group["actions"] = rng.normal(size=(6, 2)) + number // 2
    names = {f"demos/demo_{number}": f"task {number // 2}" for number in range(12)}
    (path / "tasks.json").write_text(json.dumps(names))


def disturb(folder: pathlib.Path, at: int, kind: str) -> list[int]:
    """Counts the operations on files in a folder, and lets the one with number `at` fail; 0 for none.

    Returns:
        A list whose only entry is the number of operations so far.
    """
    count, inside = [0], f"{folder.resolve()}{os.sep}"

    def audit(event: str, arguments: tuple) -> None:
        if event in _EVENTS and isinstance(path := arguments[_EVENTS[event]], str | bytes | os.PathLike):
            begins(path)

    def watched(function: Callable[..., Any]) -> Callable[..., Any]:
        """Watches a function without an audit event, whose first argument is an open file."""

        def call(file: Any, *arguments: Any) -> Any:
            begins(pathlib.Path(f"/proc/self/fd/{file if isinstance(file, int) else file.fileno()}").readlink())
            return function(file, *arguments)

        return call

    def begins(path: str | bytes | os.PathLike) -> None:
        if not os.path.abspath(os.fsdecode(path)).startswith(inside):  # noqa: PTH100
            return
        count[0] += 1
        if count[0] != at:
            return
        if kind == "full":
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (1, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))
        elif kind.startswith("SIG"):
            os.kill(os.getpid(), getattr(signal, kind))
        else:
            number = getattr(errno, kind)
            raise OSError(number, os.strerror(number), path)

    sys.addaudithook(audit)
    os.fsync, fcntl.flock = watched(os.fsync), watched(fcntl.flock)
    return count


def plan(folder: pathlib.Path) -> Any:
    """Plans 12 demonstrations in three parts, or goes on with them, and returns them."""
    import milx
    from milx.config.schema import DataConfig
    from milx.data import simulated

    settings = DataConfig(plan_batch=4, plan_iterations=2)
    return simulated.cached(folder / "cache", milx.make("reach_state"), 0, "train", 4, 3, settings)


def live(folder: pathlib.Path, at: int, kind: str, planning: bool = False) -> None:
    """Lives a life, or goes on with one, and prints its result as JSON."""
    import milx
    from milx.core import commands, pytrees

    logging.set_verbosity(logging.ERROR)  # as the launchers do
    milx.configure()
    count = disturb(folder, at, kind)
    with commands.command():
        made = plan(folder) if planning else train(folder)
    operations = ctypes.CDLL(None).fail_calls_count() if "FAIL_IN" in os.environ else count[0]
    print(json.dumps({"params": pytrees.fingerprint(made), "operations": operations}))


def train(folder: pathlib.Path) -> Any:
    """Imports, trains, evaluates, exports and loads, or goes on with that, and returns the parameters."""
    import milx
    from milx.data import episodes
    from milx.data.robomimic import Robomimic
    from milx.deploy import standalone
    from milx.deploy.export import export
    from milx.training import recorded
    from milx.training.factory import make_run

    if not (folder / "set").exists():
        source = Robomimic(folder.parent / "demos.hdf5", "", "robot", "actions", 8)
        found = source.episodes(str(folder.parent / "tasks.json"))
        episodes.write(folder / "set", found, source.contents, (0.2, 0.2), "a recording")
    config = recorded.config_for(folder / "set", preset="cpu")
    config.recorded.horizon, config.network.fc_layers = 6, (8,)
    config.train.meta_batch, config.train.log_every, config.train.eval_every = 2, 2, 4
    config.train.steps = 8
    run = make_run(config, folder / "run")
    run.train()
    run.evaluate()
    if not (folder / "exported").exists():
        export(milx.load(folder / "run"), folder / "exported")
    standalone.Policy(folder / "exported")
    return milx.load(folder / "run").params


class Outcome(NamedTuple):
    """How a process ended, and what it said on both streams."""

    code: int
    seconds: float
    output: str
    errors: str
    result: dict[str, Any]


def _heed_signals() -> None:
    """Lets a new process heed signals that this one may have been told to ignore, for example by `nohup`."""
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)


def compile_calls(folder: pathlib.Path) -> pathlib.Path:
    """Compiles the library that lets calls to the C library fail."""
    library = folder / "fail_calls.so"
    source = pathlib.Path(__file__).with_name("fail_calls.c")
    subprocess.run(["cc", "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], check=True)
    return library


def begin(
    folder: pathlib.Path, at: int = 0, kind: str = "", library: pathlib.Path | None = None, planning: bool = False
) -> Outcome:
    """Lives in a process of its own, in which an operation of Python fails or, with the library, a call."""
    command = [sys.executable, __file__, f"--life={folder}", *["--planning"] * planning]
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(folder.parent / "programs")}
    if library:
        number = str(int(getattr(signal, kind))) if kind.startswith("SIG") else kind
        environment |= {"LD_PRELOAD": str(library), "FAIL_IN": f"{folder.resolve()}{os.sep}"}
        environment |= {"FAIL_AT": str(at), "FAIL_KIND": number}
    else:
        command += [f"--at={at}", f"--kind={kind}"]
    began = time.perf_counter()
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=DEADLINE, env=environment, preexec_fn=_heed_signals
        )
    except subprocess.TimeoutExpired:
        return Outcome(-1000, DEADLINE, "", "", {})
    result: dict[str, Any] = {}
    with contextlib.suppress(ValueError, IndexError):
        result = json.loads(done.stdout.splitlines()[-1]) if done.returncode == 0 else {}
    return Outcome(done.returncode, time.perf_counter() - began, done.stdout, done.stderr, result)


def wrong(disturbed: Outcome, again: Outcome, kind: str, params: str) -> list[str]:
    """Lists what is wrong with a life that was disturbed and begun again."""
    allowed = {"SIGKILL": (-9,), "SIGTERM": (143,), "SIGINT": (130,), "SIGHUP": (129,)}.get(kind, (0, 1))
    found = []
    if disturbed.code not in allowed:
        found.append(f"exit code {disturbed.code}, expected {' or '.join(map(str, allowed))}")
    # Threads of Orbax may print tracebacks before milx's message, but nothing may come in its place.
    _, message, rest = f"\n{disturbed.errors}".rpartition("\nmilx: ")
    if disturbed.code == 1 and (not message or "Traceback" in rest):
        found.append("no message, or a traceback in its place")
    if disturbed.code == 0 and disturbed.result.get("params") != params:
        found.append("ended well with other parameters")
    if again.code != 0 or again.result.get("params") != params:
        found.append(f"begun again, it ended with {again.code}: {again.errors[-300:]}")
    return found


def fail_once(
    folder: pathlib.Path,
    at: int,
    kind: str,
    params: str,
    library: pathlib.Path | None = None,
    planning: bool = False,
) -> dict[str, Any]:
    """Disturbs a life, begins it again, and reports both."""
    mine = folder / f"{at:04d}-{kind}"
    mine.mkdir()
    disturbed = begin(mine, at, kind, library, planning)
    again = begin(mine, planning=planning)
    shutil.rmtree(mine)
    return {
        "operation": at,
        "kind": kind,
        "code": disturbed.code,
        "seconds": disturbed.seconds,
        "wrong": wrong(disturbed, again, kind, params),
        "said": (disturbed.output + disturbed.errors)[-2000:],
    }


def main(_: list[str]) -> None:
    """Lives undisturbed, then once for each operation."""
    if FLAGS.life is not None:
        live(pathlib.Path(FLAGS.life), FLAGS.at, FLAGS.kind, FLAGS.planning)
        return
    from milx.core import files
    from milx.evaluation import provenance

    results = pathlib.Path(__file__).parents[1] / "results" / "robustness"
    file = "-".join(["failures", *["planning"] * FLAGS.planning, *["calls"] * FLAGS.calls, "cpu.json"])
    out = pathlib.Path(FLAGS.out or results / file)
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        write_recording(folder)
        library = compile_calls(folder) if FLAGS.calls else None
        possible = CALL_KINDS if FLAGS.calls else KINDS
        kinds = FLAGS.kinds or possible
        if unknown := sorted(set(kinds) - set(possible)):
            raise app.UsageError(f"--kinds: got {unknown[0]!r}, expected some of {', '.join(possible)}")
        for number in range(2):  # the first one compiles
            (folder / f"good{number}").mkdir()
            good = begin(folder / f"good{number}", library=library, planning=FLAGS.planning)
            print(f"undisturbed: exit code {good.code}, {good.seconds:.1f} s, {good.result}", flush=True)
        params, operations = good.result["params"], good.result["operations"]
        numbers = range(FLAGS.first, operations + 1, FLAGS.every)
        with concurrent.futures.ThreadPoolExecutor(FLAGS.processes) as pool:
            pairs = zip(numbers, itertools.cycle(kinds), strict=False)
            lives = []
            for life in pool.map(
                lambda pair: fail_once(folder, pair[0], pair[1], params, library, FLAGS.planning), pairs
            ):
                lives.append(life)
                if life["wrong"]:
                    print(
                        f"{life['operation']} {life['kind']}: {'; '.join(life['wrong'])}\n{life['said'][-600:]}",
                        flush=True,
                    )
    bad = sum(bool(life["wrong"]) for life in lives)
    print(f"{len(lives)} lives of {operations} operations, {bad} went wrong")
    for life in lives:
        del life["said"]
    files.write_json(out, {"operations": operations, "lives": lives} | provenance.origin())


if __name__ == "__main__":
    flags.DEFINE_bool("calls", False, "Calls to the C library instead of operations of Python.")
    flags.DEFINE_bool("planning", False, "Lives that plan demonstrations, and no more.")
    flags.DEFINE_list("kinds", None, "What happens; with several, each operation gets the next one. Default all.")
    flags.DEFINE_integer("first", 1, "The first operation.", lower_bound=1)
    flags.DEFINE_integer("every", 1, "Only every so many operations.", lower_bound=1)
    flags.DEFINE_integer("processes", 2, "Lives at once.", lower_bound=1)
    flags.DEFINE_string("out", None, "The JSON file; default one in experiments/results/robustness.")
    flags.DEFINE_string("life", None, "Folder of a life to live, in place of all the above.")
    flags.DEFINE_integer("at", 0, "With --life: the operation at which it is disturbed; 0 for none.")
    flags.DEFINE_string("kind", "", "With --life: by what.")
    app.run(main)
