"""The parameters of another policy, or of a file, that training starts from.

A file holds arrays by name. A name is that of a parameter (`pytrees.leaves`), or its end: "vision.ConvBlock_0.kernel"
is the first convolution's kernel [k, k, channels, filters] in all networks that see images, whatever the method. A
convolution also has a "bias" [filters] and a "centre" [filters], which is added after the norm; images come in as
[H, W, 3] in [0, 1]. Residual block j after convolution i has "Residual_i_j_0" and "Residual_i_j_1", with such arrays.
"""

import pathlib

import jax.numpy as jnp
import numpy as np

from milx.core import pytrees
from milx.core.messages import say
from milx.deploy.pretrained import load
from milx.types import Params

FILES = (".safetensors", ".npz")
"""The endings of files with parameters."""


def start_from(source: str, params: Params) -> Params:
    """Replaces parameters by those of a trained policy that have the same names and sizes, or by those of a file.

    The whitening stays, as it belongs to the data.

    Args:
        source: a file that ends in one of FILES, or what `milx.load` takes.
        params: what a method has drawn.

    Raises:
        ValueError: if there is no such policy, or it has nothing in common with these parameters; if the file cannot be
            read, or holds an array for which there is no parameter of that name and shape.
    """
    learned = {name: value for name, value in pytrees.leaves(params).items() if not name.startswith("whitening")}
    theirs = _of_file(source, learned) if source.endswith(FILES) else pytrees.leaves(_of_policy(source))
    started, names = pytrees.overlaid(params, theirs)
    if not names:
        expected = "a policy with parameters of the same names and sizes: the same method and a similar network"
        raise ValueError(
            f"init: got {source!r}, which has none of the {len(learned)} parameters here, expected {expected}"
        )
    say(f"{len(names)} of {len(learned)} parameters start from {source}; all others are drawn")
    return started


def check_source(source: str) -> None:
    """Raises ValueError if there is nothing to start from."""
    if source.endswith(FILES):
        pytrees.read_tensors(pathlib.Path(source))
    else:
        load(source)


def _of_policy(run: str) -> Params:
    return {name: part for name, part in load(run).params.items() if name != "whitening"}


def _of_file(path: str, learned: Params) -> dict[str, np.ndarray]:
    """Reads what a file has for the parameters, by their names."""
    found = {}
    for name, array in pytrees.read_tensors(pathlib.Path(path)).items():
        meant = [own for own in learned if f".{own}".endswith(f".{name}")]
        if not meant:
            raise ValueError(f"init: {path}: {name}: there is no such parameter, expected one of {', '.join(learned)}")
        for own in meant:
            if array.shape != (shape := jnp.shape(learned[own])):
                raise ValueError(f"init: {path}: {name}: got {array.shape}, expected {shape}, as {own} has")
            found[own] = array
    return found
