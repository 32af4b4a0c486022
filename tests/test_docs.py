"""The how-tos are true: their Python blocks run from top to bottom, and their commands exist."""

import importlib
import pathlib
import re

import pytest

from milx.config import registry

DOCS = pathlib.Path(__file__).parents[1] / "docs"


PAGES = sorted(DOCS.rglob("*.md"))


def blocks(path, language):
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(), re.MULTILINE | re.DOTALL)


@pytest.fixture
def registries():
    """Forgets afterwards what the how-tos register."""
    before = [(each, dict(each)) for each in (registry.ENVS, registry.METHODS, registry.PRESETS)]
    yield
    for each, entries in before:
        each.clear()
        each.update(entries)


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=[pytest.mark.slow] if path.stem == "your_own_demonstrations" else [], id=path.stem)
        for path in PAGES
        if blocks(path, "python")
    ],
)
def test_the_blocks_of_a_how_to_run(path, tmp_path, monkeypatch, cache, registries):
    monkeypatch.chdir(tmp_path)
    scope = {"__name__": "__main__"}
    code = blocks(path, "python")
    for block in code:
        exec(compile(block, path.name, "exec"), scope)


@pytest.mark.parametrize("path", [*PAGES, *sorted(DOCS.parent.glob("*.md"))], ids=lambda path: path.stem)
def test_links_and_commands_lead_somewhere(path):
    text = path.read_text()
    for link in re.findall(r"\]\(([^)#]+)\)", text):
        assert link.startswith("http") or (path.parent / link).exists(), link
    for module in re.findall(r"python -m (milx[\w.]*)", text):
        assert importlib.util.find_spec(module), module
    for file, name in re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", text):
        assert f"def {name}(" in (DOCS.parent / file).read_text(), f"{file}::{name}"
    for script in re.findall(r"python (experiments/\S+\.py)", text):
        assert (DOCS.parent / script).is_file(), script
