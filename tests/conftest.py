"""One tiny run, planned, trained and evaluated once in each test process; tests of its parts look at what it left."""

import dataclasses
import json
import os
import pathlib
from typing import Any

import jax
import pytest
from tiny import QUIET, tiny_config
from xdist.scheduler import LoadScopeScheduling

import milx
from milx.config.schema import Config
from milx.data.simulated import DemoSet
from milx.training.simulated import SimulatedRun

milx.configure()
# Compiling takes longer than running here.
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=1"


@dataclasses.dataclass(frozen=True)
class Trained:
    """A finished run, and the demonstrations that it used."""

    run: SimulatedRun
    result: dict[str, Any]
    train: DemoSet
    validation: DemoSet
    test: DemoSet

    @property
    def folder(self) -> pathlib.Path:
        return self.run.folder

    @property
    def config(self) -> Config:
        return self.run.config

    @property
    def metrics(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in (self.folder / "metrics.jsonl").read_text().splitlines()]


FIRST = (
    *("test_run.py", "test_parallel.py", "test_notebook.py"),
    *("test_cells.py", "test_simulated.py", "test_closed_loop.py", "test_policy.py"),
)
"""The files that take longest, so that in the end no process is left alone with one of them."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Puts FIRST first."""
    items.sort(key=lambda item: FIRST.index(item.path.name) if item.path.name in FIRST else len(FIRST))


class Scheduling(LoadScopeScheduling):
    """A file's tests run in one process, and all files that look at the tiny run in the same one."""

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.split("::")[0]
        looks = pathlib.Path(file).name in FIRST and not file.endswith(("test_parallel.py", "test_notebook.py"))
        return "the tiny run" if looks else file


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Scheduling:
    """Schedules the tests where there are several processes; xdist calls it."""
    return Scheduling(config, log)


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory):
    """Caches demonstrations for this session only; compiled programs stay where milx puts them.

    Both hold for processes that tests start, too.
    """
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setenv("JAX_COMPILATION_CACHE_DIR", os.fspath(jax.config.jax_compilation_cache_dir))
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield folder


@pytest.fixture(scope="session")
def trained(cache, tmp_path_factory) -> Trained:
    run = SimulatedRun(tiny_config(), tmp_path_factory.mktemp("run"), QUIET)
    run.train()
    result = run.evaluate()
    return Trained(run, result, *(run.demos(split) for split in ("train", "validation", "test")))
