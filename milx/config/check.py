"""Checks of a configuration's values: their types and their ranges."""

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from typing import Any

from milx.config.schema import PHYSICS, Config, ConvConfig

MOST = 10**9
"""The maximum of integer fields that declare none."""
_LARGEST = 1e30


def check_config(config: Config) -> None:
    """Checks every field of a configuration.

    Raises:
        ValueError: if a value is not allowed; the message names the field, its value and what was expected.
    """
    _check_group(config, "")
    recorded = config.recorded
    for field, value, only in (("recorded.history", recorded.history, 1), ("recorded.crop", recorded.crop, 0)):
        if value != only and not recorded.path:
            raise ValueError(f"{field}: got {value}, expected {only} in simulation")
    if config.env.physics not in PHYSICS:
        raise ValueError(f"env.physics: got {config.env.physics!r}, expected one of {', '.join(PHYSICS)}")
    network = config.network
    if isinstance(network, ConvConfig) and len(network.filters) != len(network.strides):
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
            _check_value(name, value, hints[field.name], field.metadata)


def _check_value(name: str, value: Any, hint: Any, limits: Mapping[str, float]) -> None:
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
            _check_number(name, entry, each, limits)
    elif hint in (int, float):
        _check_number(name, value, hint, limits)
    elif not isinstance(value, hint):
        raise ValueError(f"{name}: got {value!r}, expected {'true or false' if hint is bool else 'text'}")


def _check_number(name: str, value: Any, hint: type, limits: Mapping[str, float]) -> None:
    allowed = (int,) if hint is int else (int, float)
    low, high = limits.get("low", 1), limits.get("high", math.inf)
    most = high if high < math.inf else MOST if hint is int else _LARGEST
    if not isinstance(value, allowed) or isinstance(value, bool) or not low <= value <= most:
        kind = "a whole number" if hint is int else "a finite number"
        bounds = f"at least {low}" + (f" and at most {most}" if most < _LARGEST else "")
        raise ValueError(f"{name}: got {value!r}, expected {kind}, {bounds}")
