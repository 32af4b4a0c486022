"""Conversion of configurations with an earlier layout, as result files and stored policies contain them.

Version 1 had no version number. All methods shared one class of network settings and one group "mil", so a
configuration also held fields that its method did not use. In version 2, `lstm_attention` still had the settings of
convolutions and of a goal head. In version 3, no iterations of iLQR meant the controller of push,
which is in `experiments/paper` now.
"""

from typing import Any

VERSION = 4
"""Of the layout. It must rise with a new field in which None means something else than what milx did before it, since
unknown fields that are None are ignored."""

_OF_ALL = ("loss_scale", "whiten_actions", "goal_weight", "given")
_NETWORK: dict[Any, tuple[str, ...]] = {
    "mil": (
        *("bias_transformation", "heads", "inner_first_layer"),
        *("target_head", "hindsight_head", "learned_loss"),
    ),
    "contextual": ("context",),
    "lstm": ("context", "context_frames"),
    "lstm_attention": ("context",),
}
"""By method: the fields of its networks' settings that not all methods have."""
_OF_VISION = (
    *("filters", "strides", "kernel", "fixed_filters", "mixed_precision", "rematerialise", "soft_argmax"),
    *("goal_head", "calibrate"),
)


def migrate(values: dict[str, Any]) -> dict[str, Any]:
    """Converts the values of a configuration to the current layout and removes their version.

    Raises:
        ValueError: for an unknown version.
    """
    version = values.get("config_version", 1)
    if version not in (1, 2, 3, VERSION):
        raise ValueError(f"config_version: got {version!r}, expected at most {VERSION}: made by a later milx")
    values = {name: value for name, value in values.items() if name != "config_version"}
    if version == 1:
        values = _from_version_1(values)
    if version <= 2:
        values = _from_version_2(values)
    return values if version == VERSION else _from_version_3(values)


def _from_version_1(values: dict[str, Any]) -> dict[str, Any]:
    groups = {name: values.get(name, {}) for name in ("mil", "network", "train")}
    if not all(isinstance(group, dict) for group in groups.values()):
        return values  # the caller rejects a group that is not a dictionary
    method_name, (mil, network, train) = str(values.get("method_name", "mil")), map(dict, groups.values())
    if "redraw_appearance" in train:  # the field's earlier name
        train["redraw"] = train.pop("redraw_appearance")
    steps = {"imitation_steps": train.pop("imitation_steps")} if "imitation_steps" in train else {}
    method = mil | steps if method_name == "mil" else {name: mil[name] for name in _OF_ALL if name in mil}
    others = {name for names in _NETWORK.values() for name in names} - set(_NETWORK.get(method_name, ()))
    network = {name: value for name, value in network.items() if name not in others}
    rest = {name: value for name, value in values.items() if name not in groups}
    groups = {"method": method, "network": network, "train": train}
    return rest | {name: group for name, group in groups.items() if group}


def _from_version_2(values: dict[str, Any]) -> dict[str, Any]:
    network = values.get("network")
    if values.get("method_name") != "lstm_attention" or not isinstance(network, dict):
        return values
    return values | {"network": {name: value for name, value in network.items() if name not in _OF_VISION}}


def _from_version_3(values: dict[str, Any]) -> dict[str, Any]:
    data = values.get("data")
    if not isinstance(data, dict) or data.get("plan_iterations") != 0 or data.get("expert", "ilqr") != "ilqr":
        return values
    return values | {"data": data | {"expert": "controller"}}
