"""Policies that ship with milx: `milx.load("push")`."""

import json
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from milx import config as config_lib
from milx import envs, methods, policy
from milx.data import demos as demos_lib
from milx.policy import Policy, params_like, spec_of

FOLDER = pathlib.Path(__file__).parent / "pretrained"


def names() -> list[str]:
    """The policies that there are."""
    return sorted(path.parent.name for path in FOLDER.glob("*/params.npz"))


def result(name: str) -> dict[str, Any]:
    """What one of them reached: the evaluation.json of its run, and a hash of the parameters (`demos.fingerprint`)."""
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
    like = params_like(method, spec)
    with np.load(FOLDER / run / "params.npz", allow_pickle=False) as arrays:
        leaves = [jnp.asarray(arrays[name]) for name in demos_lib.leaves(like)]
    return Policy(method, spec, jax.tree.unflatten(jax.tree.structure(like), leaves), config)


def save(trained: Policy, reached: dict[str, Any], folder: pathlib.Path) -> None:
    """Writes a policy as `load` reads it.

    Args:
        trained: the policy of a run in an environment.
        reached: the run's evaluation.json, configuration included.
        folder: where to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    arrays: dict[str, Any] = {name: np.asarray(leaf) for name, leaf in demos_lib.leaves(trained.params).items()}
    np.savez_compressed(folder / "params.npz", **arrays)
    digest = demos_lib.fingerprint(trained.params)
    (folder / "result.json").write_text(json.dumps(reached | {"params_hash": digest}, indent=1) + "\n")
