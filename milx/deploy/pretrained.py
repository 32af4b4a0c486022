"""Policies that ship with milx: `milx.load("push")`."""

import pathlib
from typing import Any

from milx import envs, methods
from milx.config import assemble
from milx.config.registry import load_plugins
from milx.core import files, pytrees
from milx.core.messages import warn
from milx.deploy import policy
from milx.deploy.policy import Policy
from milx.methods import params_like

FOLDER = pathlib.Path(__file__).parent / "weights"
FORMAT = 1
"""The number of what `save` writes."""


def names() -> list[str]:
    """Returns the names of the policies that ship with milx."""
    return sorted(path.parent.name for path in FOLDER.glob("*/params.npz"))


def result(name: str) -> dict[str, Any]:
    """Reads a policy's result: its run's evaluation.json, and `pytrees.fingerprint` of its parameters."""
    return files.read_json(_path(name, "result.json"))


def load(run: str | pathlib.Path) -> Policy:
    """Loads the best policy of a run, or one that ships with milx.

    Args:
        run: the run's folder, as `python -m milx.train` writes it, or the name of a policy that ships with milx. A
            folder of that name comes first, which is reported.

    Raises:
        ValueError: if it is neither, if the run has no checkpoint yet, or if the files have been changed.
    """
    load_plugins()  # a run may be of another package's method or environment
    is_run = (pathlib.Path(run) / "config.json").is_file()
    if is_run and str(run) in names():
        warn(f"loading the run in ./{run}, not the policy {str(run)!r} that ships with milx")
    if is_run or (pathlib.Path(run).exists() and str(run) not in names()):
        return policy.load_run(run)
    if str(run) not in names():
        expected = f"the folder of a run, or one of {', '.join(names())}, which ship with milx"
        raise ValueError(f"run: got {str(run)!r}, expected {expected}")
    reached = result(str(run))
    if (number := reached.get("format", 1)) != FORMAT:  # the first had no number
        got = f"got format {number!r:.100}, expected {FORMAT}"
        raise files.FileError(f"{_path(str(run), 'result.json')}: {got}: it may be of a later milx")
    config = assemble.from_dict(reached["config"])
    spec = envs.of_config(config).spec
    method = methods.make(config, spec)
    path = _path(str(run), "params.npz")
    params = pytrees.read(path, like=params_like(method, spec))
    if pytrees.fingerprint(params) != reached["params_hash"]:
        raise files.FileError(f"{path}: has changed, expected the parameters that ship with milx")
    return Policy(method, spec, params, config)


def save(trained: Policy, reached: dict[str, Any], folder: pathlib.Path) -> None:
    """Writes a policy in the format of those that ship with milx.

    Args:
        trained: the policy of a run in simulation.
        reached: the contents of the run's evaluation.json, with the configuration.
        folder: the folder to write to.
    """
    pytrees.write(folder / "params.npz", trained.params)
    digest = pytrees.fingerprint(trained.params)
    files.write_json(folder / "result.json", reached | {"format": FORMAT, "params_hash": digest})


def _path(name: str, file: str) -> pathlib.Path:
    """Finds a file of a policy; some package managers install links."""
    return (FOLDER / name / file).resolve()
