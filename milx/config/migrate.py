"""Configurations of earlier layouts, as they stand in result files and beside policies.

Version 1 had no number. All methods shared one class of networks and one group "mil"; a field that a method did not
read stood there all the same.
"""

from typing import Any

VERSION = 2

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
"""What the networks of a method have that others do not."""


def migrate(values: dict[str, Any]) -> dict[str, Any]:
    """The values of a configuration in today's layout, without their version.

    Raises:
        ValueError: for a version that is not known.
    """
    version = values.get("config_version", 1)
    if version not in (1, VERSION):
        raise ValueError(f"config_version: got {version!r}, expected at most {VERSION}: made by a later milx")
    values = {name: value for name, value in values.items() if name != "config_version"}
    return values if version == VERSION or "method" in values else _from_version_1(values)


def _from_version_1(values: dict[str, Any]) -> dict[str, Any]:
    groups = {name: values.get(name, {}) for name in ("mil", "network", "train")}
    if not all(isinstance(group, dict) for group in groups.values()):
        return values  # which is refused for what it is
    method_name, (mil, network, train) = values.get("method_name", "mil"), map(dict, groups.values())
    if "redraw_appearance" in train:  # its first name
        train["redraw"] = train.pop("redraw_appearance")
    steps = {"imitation_steps": train.pop("imitation_steps")} if "imitation_steps" in train else {}
    method = mil | steps if method_name == "mil" else {name: mil[name] for name in _OF_ALL if name in mil}
    others = {name for names in _NETWORK.values() for name in names} - set(_NETWORK.get(method_name, ()))
    network = {name: value for name, value in network.items() if name not in others}
    rest = {name: value for name, value in values.items() if name not in groups}
    groups = {"method": method, "network": network, "train": train}
    return rest | {name: group for name, group in groups.items() if group}
