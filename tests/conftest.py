"""One tiny run, planned, trained and evaluated once in each test process; tests of its parts look at what it left."""

import dataclasses
import json
import os
import pathlib
from typing import Any

import jax
import pytest
from tiny import QUIET, tiny_config

from milx.config import Config
from milx.data.demos import DemoSet
from milx.run import Run


@dataclasses.dataclass(frozen=True)
class Trained:
    """A finished run, and the demonstrations that it used."""

    run: Run
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


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The files that take longest first, so that in the end no process is left alone with one of them."""
    items.sort(key=lambda item: item.path.name not in ("test_parallel.py", "test_notebook.py"))


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory):
    """Demonstrations are cached for this session only; compiled programs stay where milx puts them.

    Both hold for processes that tests start, too.
    """
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setenv("JAX_COMPILATION_CACHE_DIR", os.fspath(jax.config.jax_compilation_cache_dir))
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield folder


@pytest.fixture(scope="session")
def trained(cache, tmp_path_factory) -> Trained:
    run = Run(tiny_config(), tmp_path_factory.mktemp("run"), QUIET)
    run.train()
    result = run.evaluate()
    return Trained(run, result, *(run.demos(split) for split in ("train", "validation", "test")))
