"""Checks of a configuration's values: their types, and that they lie where they mean something."""

import dataclasses
import math
import types
import typing
from typing import Any

_LARGE = 10**9
_SIZES = (1, 1 << 14)
"""Least and greatest size of a layer or a side of an image: more is a slip of the finger."""
_LIMITS: dict[str, tuple[float, float]] = {
    "seed": (0, 2**32 - 1),
    "env.image_shape": (1, 4096),
    "env.action_cost": (0, math.inf),
    "data.noise": (0, math.inf),
    "data.spare_demos": (0, 1000),
    "data.plan_iterations": (0, 10_000),
    "recorded.horizon": (1, 100_000),
    "recorded.goal_indices": (0, 100_000),
    "recorded.gib": (0, 100_000),
    "network.filters": _SIZES,
    "network.strides": (1, 64),
    "network.kernel": (1, 64),
    "network.fc_layers": _SIZES,
    "network.fc_init_std": (0, math.inf),
    "network.bias_transformation": (0, _SIZES[1]),
    "network.heads": (1, 2),
    "network.context": _SIZES,
    "network.context_frames": (1, 10_000),
    "mil.inner_steps": (0, 1000),
    "mil.inner_lr": (0, math.inf),
    "mil.inner_clip": (0, math.inf),
    "mil.loss_scale": (0, math.inf),
    "mil.goal_weight": (0, math.inf),
    "train.imitation_steps": (0, _LARGE),
    "optimizer.learning_rate": (0, math.inf),
    "optimizer.warmup": (0, 1),
    "optimizer.clip_norm": (0, math.inf),
}
"""The least and the greatest value of a field, or of its entries. Other numbers are counts, from 1."""


def check_config(config: Any) -> None:
    """Checks every field of a configuration.

    Raises:
        ValueError: naming the field, its value and what was expected.
    """
    _check_group(config, "")
    network = config.network
    if len(network.filters) != len(network.strides):
        expected = f"as many as network.filters = {network.filters}"
        raise ValueError(f"network.strides: got {network.strides}, expected {expected}")


def _check_group(group: Any, prefix: str) -> None:
    hints = typing.get_type_hints(type(group))
    for field in dataclasses.fields(group):
        name, value = f"{prefix}{field.name}", getattr(group, field.name)
        if dataclasses.is_dataclass(hints[field.name]):
            if not isinstance(value, hints[field.name]):
                raise ValueError(f"{name}: got {value!r}, expected a group of fields")
            _check_group(value, f"{name}.")
        else:
            _check_value(name, value, hints[field.name])


def _check_value(name: str, value: Any, hint: Any) -> None:
    """Checks one field against its type and its limits."""
    if isinstance(hint, types.UnionType):
        if value is None:
            return
        hint = next(option for option in typing.get_args(hint) if option is not types.NoneType)
    if typing.get_origin(hint) is tuple:
        entries, each = typing.get_args(hint), typing.get_args(hint)[0]
        if not isinstance(value, tuple) or (entries[-1] is not Ellipsis and len(value) != len(entries)):
            count = "" if entries[-1] is Ellipsis else f"{len(entries)} "
            raise ValueError(f"{name}: got {value!r}, expected a tuple of {count}numbers")
        for entry in value:
            _check_number(name, entry, each)
    elif hint in (int, float):
        _check_number(name, value, hint)
    elif not isinstance(value, hint):
        raise ValueError(f"{name}: got {value!r}, expected {'true or false' if hint is bool else 'text'}")


def _check_number(name: str, value: Any, hint: type) -> None:
    allowed = (int,) if hint is int else (int, float)
    least, most = _LIMITS.get(name, (1, _LARGE))
    if not isinstance(value, allowed) or isinstance(value, bool) or not least <= value <= min(most, 1e30):
        kind = "a whole number" if hint is int else "a finite number"
        bounds = f"at least {least}" + ("" if most in (_LARGE, math.inf) else f" and at most {most}")
        raise ValueError(f"{name}: got {value!r}, expected {kind}, {bounds}")
