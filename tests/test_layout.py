"""The house as BUILD.md draws it: which package may import which, and how large modules are."""

import ast
import pathlib

import pytest

ROOT = pathlib.Path(__file__).parents[1]
FLOORS = (
    {"types", "core"},
    {"config", "render"},
    {"networks", "envs"},
    {"methods", "trajopt"},
    {"data"},
    {"evaluation", "deploy", "gym"},
    {"worlds"},
    {"training", "export", ""},
    {"train", "evaluate", "collect"},
)
"""Packages and modules of milx, from the lowest floor up; "" is `milx/__init__.py`."""
NUMBER = {room: number for number, floor in enumerate(FLOORS) for room in floor}


def rooms(path):
    """Returns the packages or modules of milx that a file imports, also inside functions."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "milx":
            inside = node.module.split(".")[1:]
            found |= {inside[0]} if inside else {alias.name for alias in node.names}
        elif isinstance(node, ast.Import):
            names = [alias.name.split(".") for alias in node.names]
            found |= {(*name, "")[1] for name in names if name[0] == "milx"}
    return {room if room in NUMBER else "" for room in found}


@pytest.mark.parametrize("path", sorted((ROOT / "milx").rglob("*.py")), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_run_downward_and_modules_are_short(path):
    room = path.relative_to(ROOT / "milx").parts[0].removesuffix(".py").removeprefix("__init__")
    upward = {other for other in rooms(path) - {room} if NUMBER[other] >= NUMBER[room]}
    assert not upward, f"{room} is on floor {NUMBER[room]}"
    assert len(path.read_text().splitlines()) <= 350


def test_few_modules_lie_beside_the_packages():
    assert len(list((ROOT / "milx").glob("*.py"))) <= 8


@pytest.mark.parametrize("path", sorted((ROOT / "milx").rglob("*.py")), ids=lambda path: str(path.relative_to(ROOT)))
def test_files_are_read_and_written_in_one_place(path):
    """Looks for the calls with which Python opens, writes, renames and removes files."""
    if path.name in ("files.py", "standalone.py"):  # the latter is copied to where milx is not
        return
    forbidden = {"read_text", "write_text", "read_bytes", "write_bytes", "savez", "savez_compressed", "fsync", "touch"}
    forbidden |= {"rename", "unlink", "rmtree", "move", "memmap", "fromfile", "tofile"}
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.Call):
            continue
        if isinstance(node.func, ast.Name):
            assert node.func.id != "open"
        elif isinstance(node.func, ast.Attribute):
            owner, name = ast.unparse(node.func.value), node.func.attr
            assert owner == "files" or name not in forbidden, ast.unparse(node)
            # Videos and images are opened by their libraries, data sets by TensorStore.
            if name == "open" and owner not in ("av", "Image", "ts"):
                assert [ast.unparse(argument) for argument in node.args[:1]] == ["os.devnull"], ast.unparse(node)
