"""Policies that ship with milx: `milx.load("push")`."""

import json
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from milx import config as config_lib
from milx import envs, methods, policy
from milx.policy import Policy, params_like, spec_of

FOLDER = pathlib.Path(__file__).parent / "pretrained"


def names() -> list[str]:
    """The policies that there are."""
    return sorted(path.parent.name for path in FOLDER.glob("*/params.npz"))


def result(name: str) -> dict[str, Any]:
    """What one of them reached: the evaluation.json of its run."""
    return json.loads((FOLDER / name / "result.json").read_text())


def load(run: str | pathlib.Path) -> Policy:
    """Loads the best policy of a run, or one that ships with milx.

    Args:
        run: the run's folder, as `python -m milx.train` leaves it, or a name.

    Raises:
        ValueError: for neither, or a run that has no checkpoint yet.
    """
    if pathlib.Path(run).exists():
        return policy.load(run)
    if run not in names():
        expected = f"the folder of a run, or one of {', '.join(names())}, which ship with milx"
        raise ValueError(f"run: got {str(run)!r}, expected {expected}")
    config = config_lib.from_dict(result(str(run))["config"])
    spec = spec_of(envs.make(config.env_name, config.env.image_shape))
    method = methods.make(config, spec)
    paths, structure = jax.tree_util.tree_flatten_with_path(params_like(method, spec))
    with np.load(FOLDER / run / "params.npz", allow_pickle=False) as arrays:
        leaves = [jnp.asarray(arrays[jax.tree_util.keystr(path, simple=True, separator=".")]) for path, _ in paths]
    return Policy(method, spec, jax.tree.unflatten(structure, leaves), config)


def save(trained: Policy, reached: dict[str, Any], folder: pathlib.Path) -> None:
    """Writes a policy as `load` reads it.

    Args:
        trained: the policy of a run in an environment.
        reached: the run's evaluation.json, configuration included.
        folder: where to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths, _ = jax.tree_util.tree_flatten_with_path(trained.params)
    arrays: dict[str, Any] = {
        jax.tree_util.keystr(path, simple=True, separator="."): np.asarray(leaf) for path, leaf in paths
    }
    np.savez_compressed(folder / "params.npz", **arrays)
    (folder / "result.json").write_text(json.dumps(reached, indent=1) + "\n")
