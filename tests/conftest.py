"""One tiny run, planned, trained and evaluated once; tests of its parts look at what it left."""

import contextlib
import dataclasses
import gc
import json
import logging
import os
import pathlib
import re
from collections.abc import Iterator
from typing import Any

import filelock
import jax
import pytest
from tiny import QUIET, tiny_config

import milx
from milx.config.schema import Config
from milx.core import platform
from milx.data.simulated import DemoSet
from milx.training.simulated import SimulatedRun

milx.configure()
# The options for drawing many pixels make programs compile twice as long, and tests draw few.
platform.pixel_options = dict
# Compiling takes longer than running here.
_FLAGS = ("backend_optimization_level=0", "llvm_disable_expensive_passes=true", "cpu_parallel_codegen_split_count=1")
os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *(f"--xla_{flag}" for flag in _FLAGS)])
# Where in the source an operation comes from would be written down for each of them.
jax.config.update("jax_traceback_in_locations_limit", 0)
# Tracing makes very many objects: a collection after every 700 of them would find little to free.
gc.freeze()
gc.set_threshold(50_000)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts one file that needs the tiny run first and the others last, so that no process waits for the other's run.

    It runs after all other hooks, when tests that are not selected, such as slow ones, have been removed.
    """
    needing = sorted({item.path for item in items if "trained" in getattr(item, "fixturenames", ())})
    rank = {path: 1 for path in needing} | {path: -1 for path in needing[:1]}
    items.sort(key=lambda item: rank.get(item.path, 0))


@dataclasses.dataclass(frozen=True)
class Trained:
    """A finished run, and the demonstrations that it used."""

    run: SimulatedRun
    result: dict[str, Any]
    train: DemoSet
    validation: DemoSet
    test: DemoSet
    compiled: list[str]
    """The names of the functions that it compiled, one after the other."""

    @property
    def folder(self) -> pathlib.Path:
        return self.run.folder

    @property
    def config(self) -> Config:
        return self.run.config

    @property
    def metrics(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in (self.folder / "metrics.jsonl").read_text().splitlines()]


@pytest.fixture(scope="session")
def shared(tmp_path_factory, worker_id) -> pathlib.Path:
    """Returns a folder that all processes of this session see."""
    folder = tmp_path_factory.getbasetemp()
    return folder if worker_id == "master" else folder.parent


@pytest.fixture(scope="session", autouse=True)
def cache(shared):
    """Caches demonstrations for this session only; compiled programs stay where milx puts them.

    Both hold for processes that tests start, too.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", os.fspath(jax.config.jax_compilation_cache_dir))
        patch.setenv("XDG_CACHE_HOME", str(shared / "cache"))
        yield shared / "cache"


@pytest.fixture(scope="session")
def quick_path(tmp_path_factory) -> str:
    """Returns a PYTHONPATH with which processes compile as this one does, without the options for many pixels.

    They import JAX when they start, but for workers, which need none.
    """
    folder = tmp_path_factory.mktemp("python")
    (folder / "sitecustomize.py").write_text(
        "import sys\n\nif not any(word.endswith('worker.py') for word in sys.orig_argv):\n"
        "    from milx.core import platform\n\n    platform.pixel_options = dict\n"
    )
    return os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])])


@pytest.fixture(scope="session")
def trained(cache, shared) -> Trained:
    """Plans, trains and evaluates the tiny run in the process that asks first; the others read what it left."""
    with filelock.FileLock(shared / "run.lock"):
        run = SimulatedRun(tiny_config(), shared / "run", QUIET)
        if not (run.folder / "evaluation.json").is_file():
            run._large = run.env  # a video of large images takes longer to draw than to compile
            with _noting_compilations() as compiled:
                run.train()
                run.evaluate()
            (shared / "compiled.json").write_text(json.dumps(compiled))
    result = json.loads((run.folder / "evaluation.json").read_text())
    compiled = json.loads((shared / "compiled.json").read_text())
    return Trained(run, result, *(run.demos(split) for split in ("train", "validation", "test")), compiled)


@contextlib.contextmanager
def _noting_compilations() -> Iterator[list[str]]:
    """Yields a list to which the names of the functions are added that JAX compiles."""
    names = []

    class Handler(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if found := re.match(r"Finished XLA compilation of jit\((.*?)\)", record.getMessage()):
                names.append(found[1])

    logger, handler = logging.getLogger("jax"), Handler()
    logger.addHandler(handler)
    jax.config.update("jax_log_compiles", True)  # in all threads, where jax.log_compiles() is for one
    try:
        yield names
    finally:
        jax.config.update("jax_log_compiles", False)
        logger.removeHandler(handler)
