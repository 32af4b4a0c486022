"""Builds configurations from presets, from JSON, and from values of single fields.

    config = make_config("reach", preset="paper")

A preset holds the values in which an environment differs from the defaults (`milx.config.registry`). A preset may set
fields that the method does not have; they are ignored. Anywhere else such a field is an error.
"""

import dataclasses
import functools
import pathlib
import typing
from typing import Any

from milx.config.check import check_config
from milx.config.migrate import VERSION, migrate
from milx.config.registry import METHODS, PRESETS
from milx.config.schema import Config
from milx.core import files


def make_config(env: str, method: str = "mil", preset: str = "fast", seed: int = 0) -> Config:
    """Builds the configuration of a preset.

    Raises:
        ValueError: for an environment, method or preset that does not exist (the message lists those that do), or a
            preset with a field that no method has.
    """
    if env not in PRESETS:
        raise ValueError(f"env: got {env!r}, expected one of {', '.join(PRESETS)}")
    if preset not in PRESETS[env]:
        raise ValueError(f"preset: got {preset!r}, expected one of {', '.join(PRESETS[env])}")
    config = default_config(method)
    config.env_name, config.preset, config.seed = env, preset, seed
    known, of_others = fields(config), {name for other in METHODS for name in fields(default_config(other))}
    for name, value in (PRESETS[env][preset] | METHODS[method].overrides).items():
        if name in known or name not in of_others:  # `assign` refuses what no method has
            assign(config, name, value)
    return config


def default_config(method: str) -> Config:
    """Builds the configuration that every preset of a method starts from.

    Raises:
        ValueError: for a method that does not exist; the message lists those that do.
    """
    if not isinstance(method, str) or method not in METHODS:
        raise ValueError(f"method: got {method!r}, expected one of {', '.join(METHODS)}")
    entry = METHODS[method]
    return Config("reach", method, "paper", network=entry.network(), method=entry.method())


def overrides(config: Config) -> dict[str, Any]:
    """Returns the fields, by dotted name, in which a configuration differs from its preset."""
    before = fields(make_config(config.env_name, config.method_name, config.preset, config.seed))
    return {name: value for name, value in fields(config).items() if value != before[name]}


def to_dict(config: Config) -> dict[str, Any]:
    """Returns the configuration as nested dictionaries for JSON, with the version of their layout."""
    return {"config_version": VERSION, **dataclasses.asdict(config)}


def from_dict(values: dict[str, Any]) -> Config:
    """Builds a configuration from the result of `to_dict`, which may have been written to JSON and read back.

    Earlier layouts are understood, too. Fields that are missing have their defaults. A field that does not exist is
    ignored if it is None, as a field is that an earlier version had and the run did not set.

    Raises:
        ValueError: for a field that does not exist (the message lists those that do), or a value that is not allowed.
    """
    if not isinstance(values, dict):
        raise ValueError(f"config: got {values!r}, expected a group of fields")
    values = migrate(values)
    config = default_config(values.get("method_name", "mil"))
    _fill(config, values, "config")
    check_config(config)
    return config


def read(path: pathlib.Path) -> Config:
    """Reads the configuration in a JSON file.

    Raises:
        FileError: if the file cannot be read or holds no valid configuration; the message names the file.
    """
    values = files.read_json(path)
    try:
        return from_dict(values)
    except (ValueError, TypeError, RecursionError) as error:
        raise files.FileError(f"{path}: expected a configuration: {error}") from error


def fields(config: Config) -> dict[str, Any]:
    """Returns the values of all fields, by dotted name."""
    return flatten(dataclasses.asdict(config))


def flatten(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flattens nested dictionaries to a single one with dotted names."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Compares two results of `to_dict`; returns one line of text for each field that differs."""
    before, after = flatten(old), flatten(new)
    names = [*before, *(name for name in after if name not in before)]
    changed = [name for name in names if before.get(name, "not there") != after.get(name, "not there")]
    return [f"{name} was {before.get(name, 'not there')}, now {after.get(name, 'not there')}" for name in changed]


def assign(config: Config, field: str, value: Any) -> None:
    """Sets the field with this dotted name.

    Raises:
        ValueError: if there is no such field, or if the value is None and the field must have a value.
    """
    if field not in fields(config):
        raise ValueError(f"config.{field}: no such field with method {config.method_name!r}")
    *path, name = field.split(".")
    holder: Any = functools.reduce(getattr, path, config)
    if value is None and type(None) not in typing.get_args(typing.get_type_hints(type(holder))[name]):
        raise ValueError(f"config.{field}: got None, expected a value")
    setattr(holder, name, value)


def _fill(group: Any, values: Any, path: str) -> None:
    """Sets the fields of a group, and of the groups inside it, to values read from JSON."""
    known = [field.name for field in dataclasses.fields(group)]
    if not isinstance(values, dict) or not all(isinstance(name, str) for name in values):
        raise ValueError(f"{path}: got {values!r}, expected a group of fields")
    values = {name: value for name, value in values.items() if name in known or value is not None}
    if unknown := sorted(set(values) - set(known)):
        raise ValueError(f"{path}: no such field {unknown[0]!r}, expected one of {', '.join(known)}")
    for name, value in values.items():
        if dataclasses.is_dataclass(getattr(group, name)):
            _fill(getattr(group, name), value, f"{path}.{name}")
        else:
            setattr(group, name, tuple(value) if isinstance(value, list) else value)
