"""The parameters of another policy, or of a file, that training starts from.

A file holds arrays by name. A name is that of a parameter (`pytrees.leaves`), or its end: "vision.ConvBlock_0.kernel"
is the first convolution's kernel [k, k, channels, filters] in all networks that see one camera, whatever the method.
Of several cameras each has its "vision_CAMERA", unless they share an encoder. A convolution also has a "bias" [filters]
and a "centre" [filters], which is added after the norm; images come in as [H, W, 3 N] in [0, 1], the latest of N first.
Residual block j after convolution i has "Residual_i_j_0" and "Residual_i_j_1", with such arrays. Parameters without
axes, such as learned inner rates, are drawn.
"""

import pathlib
from typing import Any

import numpy as np

from milx.core import pytrees
from milx.core.files import FileError
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
    learned = _learned(params)
    theirs = _of_file(source, learned) if source.endswith(FILES) else pytrees.leaves(_of_policy(source))
    started, names = pytrees.overlaid(params, theirs)
    if not names:
        expected = "a policy with parameters of the same names and sizes: the same method and a similar network"
        raise ValueError(
            f"init: got {source!r}, which has none of the {len(learned)} parameters here, expected {expected}"
        )
    say(f"{len(names)} of {len(learned)} parameters start from {source}; all others are drawn")
    return started


def check_source(source: str, params: Params) -> None:
    """Raises ValueError if there is nothing to start from, or a file does not fit the parameters, arrays or shapes."""
    if source.endswith(FILES):
        _of_file(source, _learned(params))
    else:
        load(source)


def _learned(params: Params) -> dict[str, Any]:
    return {name: value for name, value in pytrees.leaves(params).items() if not name.startswith("whitening")}


def _of_policy(run: str) -> Params:
    return {name: part for name, part in load(run).params.items() if name != "whitening"}


def _of_file(path: str, learned: dict[str, Any]) -> dict[str, np.ndarray]:
    """Reads what a file has for the parameters, by their names."""
    try:
        arrays = pytrees.read_tensors(pathlib.Path(path))
    except FileError as error:
        raise ValueError(f"init: {error}") from error
    found: dict[str, np.ndarray] = {}
    for name, array in arrays.items():
        meant = [own for own, value in learned.items() if value.shape and f".{own}".endswith(f".{name}")]
        if not meant:
            raise ValueError(f"init: {path}: {name}: there is no such parameter, expected one of {', '.join(learned)}")
        for own in meant:
            if array.shape != (shape := learned[own].shape):
                raise ValueError(f"init: {path}: {name}: got {array.shape}, expected {shape}, as {own} has")
        if twice := found.keys() & meant:
            raise ValueError(f"init: {path}: {name}: {min(twice)} is there a second time, expected each parameter once")
        if not np.isfinite(array).all():
            raise ValueError(f"init: {path}: {name}: got values that are not finite")
        found |= dict.fromkeys(meant, array)
    return found
