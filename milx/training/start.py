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

from milx.config import assemble
from milx.config.schema import Config
from milx.core import pytrees
from milx.core.files import FileError
from milx.core.messages import say
from milx.deploy.pretrained import parameters
from milx.types import Array, Params

FILES = (".safetensors", ".npz")
"""The endings of files with parameters."""
_CONVOLUTIONS = ("recorded.history", "network.residual_blocks", "network.filters", "network.kernel")
"""The fields of a configuration on which the names and shapes of convolutions' kernels depend."""
_DENSE = ("network.fc_layers",)
"""Those on which the shapes of fully connected layers' kernels depend."""


def start_from(source: str, params: Params, config: Config) -> Params:
    """Replaces parameters by those of a trained policy that have the same names and sizes, or by those of a file.

    The whitening stays, as it belongs to the data. Reports how many parameters are replaced, and what has to be set if
    kernels of a policy's convolutions do not fit.

    Args:
        source: a file that ends in one of FILES, or what `milx.load` takes.
        params: what a method has drawn.
        config: the configuration of that method.

    Raises:
        ValueError: as `check_source`.
    """
    learned = _learned(params)
    theirs, remark = _read(source, learned, config)
    started, names = pytrees.overlaid(params, theirs)
    say(f"{len(names)} of {len(learned)} parameters start from {source}; all others are drawn{remark}")
    return started


def check_source(source: str, params: Params, config: Config) -> None:
    """Checks that parameters can start from a policy or a file; takes what `start_from` takes, or shapes of parameters.

    Raises:
        ValueError: if there is no such policy, or none of its kernels has the name and shape of one of the parameters;
            if the file cannot be read, has no arrays, or has one for which there is no parameter of that name and
            shape.
    """
    _read(source, _learned(params), config)


def _learned(params: Params) -> dict[str, Any]:
    return {name: value for name, value in pytrees.leaves(params).items() if not name.startswith("whitening")}


def _read(source: str, learned: dict[str, Any], config: Config) -> tuple[dict[str, Array], str]:
    """Reads what replaces the parameters, by their names; returns it with a remark on kernels that do not fit."""
    return (_of_file(source, learned), "") if source.endswith(FILES) else _of_policy(source, learned, config)


def _of_policy(source: str, learned: dict[str, Any], config: Config) -> tuple[dict[str, Array], str]:
    """Reads what a policy has for the parameters, as `_read` does."""
    theirs, arrays = parameters(source)
    found = {
        name: arrays[name] for name, value in learned.items() if name in arrays and arrays[name].shape == value.shape
    }
    convolutions = _kernels(learned, 4)
    kernels = _kernels(learned, 2) or list(learned)  # methods of other packages may have no kernels
    drawn = [name for name in convolutions or kernels if name not in found]
    if not drawn:
        return found, ""
    if drawn[0] in arrays:
        differing = _differences(theirs, config, _CONVOLUTIONS if convolutions else _DENSE)
        expected = f"{', '.join(differing) or 'states and actions of the same sizes'}, as {source} has"
    elif any(name.startswith(f"{drawn[0].partition('.vision_')[0]}.vision.") for name in arrays):
        differing = ["network.share_encoder=True", *_differences(theirs, config, _CONVOLUTIONS)]
        expected = f"{', '.join(differing)}, as {source} has one encoder"
    else:
        expected = f"the same method, cameras and layers: {source} has no {drawn[0]}"
    if not found.keys() & kernels:
        raise ValueError(f"init: got {source!r}, none of whose kernels fits here, expected {expected}")
    if not convolutions:
        return found, ""
    count = f"{len(drawn)} of the {len(convolutions)} kernels of convolutions"
    return found, f", among them {count}, which need {expected}"


def _kernels(arrays: dict[str, Any], axes: int) -> list[str]:
    """Lists the names of kernels with at least so many axes; those of convolutions [k, k, channels, filters] have 4."""
    return [name for name, array in arrays.items() if name.endswith(".kernel") and array.ndim >= axes]


def _differences(theirs: Config, config: Config, fields: tuple[str, ...]) -> list[str]:
    """Lists those of the fields in which another configuration differs, with its values."""
    mine, other = assemble.fields(config), assemble.fields(theirs)
    if fields == _CONVOLUTIONS and len(mine["network.filters"]) != len(other["network.filters"]):
        fields = (*fields, "network.strides")  # one for each convolution
    return [f"{name}={value}" for name, value in other.items() if name in fields and value != mine.get(name)]


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
    if not found:
        raise ValueError(f"init: {path}: got no arrays, expected some of {', '.join(learned)}")
    return found
