"""The house as BUILD.md draws it: which package may import which, and how large modules are."""

import ast
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parents[1]
FLOORS = (
    {"types", "core"},
    {"config", "render", "meta"},
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


def printed(code):
    """Runs Python in a process of its own and returns what it prints."""
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def test_rendering_imports_nothing_of_the_other_packages():
    found = printed("import sys, milx.render; print(*{name.split('.')[1] for name in sys.modules if 'milx.' in name})")
    assert set(found.split()) == {"core", "render"}


@pytest.mark.parametrize(
    "first",
    [
        "import milx; names = milx.ENVS, milx.METHODS",
        "from milx.methods import METHODS; from milx.envs import ENVS; names = ENVS, METHODS",
        "from milx.config.registry import *; register_presets('mine', {}); names = ENVS, METHODS",
        "from milx.config.assemble import make_config; make_config('push'); from milx import *; names = ENVS, METHODS",
    ],
)
def test_what_milx_brings_is_registered_however_it_is_asked_for(first):
    expected = "reach reach_state push place grasp mil contextual lstm lstm_attention"
    assert printed(f"{first}; print(*names[0], *names[1])") == expected


def test_a_name_that_milx_brings_is_taken_from_the_beginning():
    code = "from milx.config import registry\ntry: registry.register_presets('push', {})\n"
    assert (
        printed(f"{code}except ValueError as error: print(error)")
        == "presets: 'push' is registered already, expected a name that is free"
    )


def test_all_that_milx_offers_is_found_where_it_says():
    import milx

    assert {*milx._HOMES, "__version__"} == set(milx.__all__)
    for name, home in milx._HOMES.items():
        assert getattr(milx, name) is getattr(sys.modules[home], name)
    assert set(milx.__all__) <= set(dir(milx))


def test_packages_are_found_as_attributes():
    code = "import milx; print(*(getattr(milx, name).__name__ for name in milx._PACKAGES))"
    found = printed(code).split()
    assert set(found) < {f"milx.{path.stem}" for path in (ROOT / "milx").glob("[a-z]*")}
    assert {"milx.envs", "milx.methods", "milx.render", "milx.data"} < set(found)


def test_another_thread_waits_until_all_is_registered():
    code = """
import threading
from milx.config.registry import ENVS
found = []
threads = [threading.Thread(target=lambda: found.append(list(ENVS))) for _ in range(4)]
for thread in threads: thread.start()
for thread in threads: thread.join()
print(len(found), *{tuple(names) for names in found})
"""
    assert printed(code) == "4 ('reach', 'reach_state', 'push', 'place', 'grasp')"


def test_a_registry_is_copied_as_a_dictionary():
    assert printed(
        "from milx.config.registry import METHODS; print(*dict(METHODS), len(METHODS), 'mil' in METHODS)"
    ) == ("mil contextual lstm lstm_attention 4 True")
