"""Policies that ship with milx: `milx.load("push")`."""

import collections
import pathlib
from typing import Any

from milx import envs, methods
from milx.config import assemble
from milx.config.registry import load_plugins
from milx.config.schema import Config
from milx.core import files, pytrees
from milx.core.messages import warn
from milx.deploy import policy
from milx.deploy.policy import Policy
from milx.methods import params_like
from milx.types import Array

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
    if _is_run(run):
        return policy.load_run(run)
    name = str(run)
    config = _config(name)
    spec = envs.of_config(config).spec
    method = methods.make(config, spec)
    params = pytrees.read(_path(name, "params.npz"), like=params_like(method, spec))
    _check_unchanged(name, params)
    return Policy(method, spec, params, config)


def parameters(run: str | pathlib.Path) -> tuple[Config, dict[str, Array]]:
    """Reads the configuration and the parameters of what `load` takes; for a policy that ships, MuJoCo is not needed.

    Returns:
        The configuration, and the arrays by name (`pytrees.leaves`).

    Raises:
        ValueError: as `load`.
    """
    load_plugins()
    if _is_run(run):
        trained = policy.load_run(run)
        return trained.config, pytrees.leaves(trained.params)
    name = str(run)
    config, arrays = _config(name), files.read_arrays(_path(name, "params.npz"))
    _check_unchanged(name, collections.OrderedDict(arrays))  # JAX sorts the names of a plain dictionary
    return config, arrays


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


def _is_run(run: str | pathlib.Path) -> bool:
    """Tells a run's folder from the name of a policy that ships with milx.

    Raises:
        ValueError: if it is neither.
    """
    has_config, ships = (pathlib.Path(run) / "config.json").is_file(), str(run) in names()
    if has_config and ships:
        warn(f"loading the run in ./{run}, not the policy {str(run)!r} that ships with milx")
    if not ships and not pathlib.Path(run).exists():
        expected = f"the folder of a run, or one of {', '.join(names())}, which ship with milx"
        raise ValueError(f"run: got {str(run)!r}, expected {expected}")
    return has_config or not ships


def _config(name: str) -> Config:
    """Reads the configuration of a policy that ships with milx.

    Raises:
        FileError: if it is of another format.
    """
    reached = result(name)
    if (number := reached.get("format", 1)) != FORMAT:  # the first had no number
        got = f"got format {number!r:.100}, expected {FORMAT}"
        raise files.FileError(f"{_path(name, 'result.json')}: {got}: it may be of a later milx")
    return assemble.from_dict(reached["config"])


def _check_unchanged(name: str, params: Any) -> None:
    """Raises FileError unless these are the parameters whose fingerprint ships with milx."""
    if pytrees.fingerprint(params) != result(name)["params_hash"]:
        raise files.FileError(f"{_path(name, 'params.npz')}: has changed, expected the parameters that ship with milx")


def _path(name: str, file: str) -> pathlib.Path:
    """Finds a file of a policy; some package managers install links."""
    return (FOLDER / name / file).resolve()
