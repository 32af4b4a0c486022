"""The how-tos are true: their Python blocks run from top to bottom, and their commands exist."""

import contextlib
import importlib
import json
import pathlib
import re
import shlex
import subprocess
import sys

import pytest

from milx.config import registry

DOCS = pathlib.Path(__file__).parents[1] / "docs"
FIXTURES = pathlib.Path(__file__).parent / "fixtures"
PAGES = sorted(DOCS.rglob("*.md"))
SLOW = ("add_an_environment", "meta_learn_anything", "render", "your_own_demonstrations")
"""Names of pages whose blocks take more than three seconds."""


def blocks(path, language):
    return re.findall(rf"^```{language}\n(.*?)^```", path.read_text(), re.MULTILINE | re.DOTALL)


def write_modules(path, folder):
    """Writes a page's blocks that begin with the name of a file, and returns its other blocks of Python."""
    rest = []
    for block in blocks(path, "python"):
        if file := re.match(r"# (\w+\.py)\n", block):
            (folder / file[1]).write_text(block)
        else:
            rest.append(block)
    return rest


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
        pytest.param(path, marks=[pytest.mark.slow] if path.stem in SLOW else [], id=path.stem)
        for path in PAGES
        if blocks(path, "python")
    ],
)
def test_the_blocks_of_a_how_to_run(path, tmp_path, monkeypatch, cache, registries):
    monkeypatch.chdir(tmp_path)
    scope = {"__name__": "__main__"}
    for block in write_modules(path, tmp_path):
        exec(compile(block, path.name, "exec"), scope)


@pytest.mark.slow
def test_the_commands_for_demonstrations_of_ones_own_run(tmp_path, monkeypatch, cache, quick_path):
    """Runs them one after the other, with shorter training, on LeRobot's and robomimic's files of the tests."""
    page = DOCS / "how_to" / "your_own_demonstrations.md"
    scope = {"__name__": "__main__"}
    monkeypatch.setenv("PYTHONPATH", quick_path)
    (writes,) = (block for block in write_modules(page, tmp_path) if "with Writer(" in block)
    with contextlib.chdir(tmp_path):
        exec(compile(writes, page.name, "exec"), scope)
    tasks = {f"lift/demo_{i}": f"lift {i}" for i in (0, 1, 2, 10)}
    (tmp_path / "tasks.json").write_text(json.dumps(tasks))
    given = {"~/datasets/my_arm": FIXTURES / "lerobot", "~/datasets/lift.hdf5": FIXTURES / "robomimic" / "lift.hdf5"}
    ran = 0
    for line in "".join(blocks(page, "bash")).splitlines():
        words = [str(given.get(word, word)) for word in shlex.split(line)]
        if words[0] == "pip":
            continue
        if "milx.train" in words:
            words += ["--preset=cpu", *(f"--config.train.{name}=10" for name in ("steps", "log_every", "eval_every"))]
        if "milx.evaluate" in words:
            words += ["--episodes=1", "--workers=2"]
        done = subprocess.run([sys.executable, *words[1:]], cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, f"{line}\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
        ran += 1
    assert ran == 11
    found = json.loads((tmp_path / "runs" / "demos" / "gym.json").read_text())["controls"]
    assert found["replay"]["ever"] > found["random"]["ever"]
    found = json.loads((tmp_path / "runs" / "demos" / "gym-new_tasks.json").read_text())
    assert found["tasks"] == ["middle/north", "middle/south"]
    assert (tmp_path / "exported_chunks" / "policy.py").is_file()


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
