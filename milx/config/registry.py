"""Environments, methods and presets by name: milx's own, and those that other packages register.

A package of yours registers what it has when it is imported. Launchers import all packages that name themselves in the
entry-point group "milx.plugins":

    [project.entry-points."milx.plugins"]
    mine = "my_package"
"""

import importlib.metadata
from collections.abc import Callable
from typing import Any, NamedTuple

from milx.config.schema import Config, MethodConfig, NetworkConfig
from milx.types import Spec

PLUGINS = "milx.plugins"
"""The entry-point group."""

Overrides = dict[str, Any]
"""Values of a configuration's fields, by dotted name."""


class MethodEntry(NamedTuple):
    """A registered method.

    Attributes:
        make: builds it from a configuration and the sizes of what it sees and does.
        network: the class of `Config.network`.
        method: the class of `Config.method`.
        overrides: what it changes of every preset.
    """

    make: Callable[[Config, Spec], Any]
    network: type[NetworkConfig]
    method: type[MethodConfig]
    overrides: Overrides


ENVS: dict[str, Any] = {}
"""Classes of environments, called with an image shape (H, W) or None."""
METHODS: dict[str, MethodEntry] = {}
PRESETS: dict[str, dict[str, Overrides]] = {}
"""By environment and name: what a preset changes of the defaults. Fields that a method does not have are left out."""


def register_env(env: Any, presets: dict[str, Overrides]) -> None:
    """Makes an environment known to `milx.make` and to `--env`.

    Args:
        env: a subclass of `milx.envs.base.Env`; its attribute `name` is its name.
        presets: by name; "fast" and "cpu" are what launchers take with and without an accelerator.

    Raises:
        ValueError: for a name that is taken.
    """
    _add(ENVS, "env", env.name, env)
    register_presets(env.name, presets)


def register_presets(env: str, presets: dict[str, Overrides]) -> None:
    """Makes the presets of an environment known.

    Raises:
        ValueError: for an environment that has presets.
    """
    _add(PRESETS, "presets", env, presets)


def register_method(
    name: str,
    make: Callable[[Config, Spec], Any],
    network: type[NetworkConfig] = NetworkConfig,
    method: type[MethodConfig] = MethodConfig,
    overrides: Overrides | None = None,
) -> None:
    """Makes a method known to `--method`.

    Args:
        name: what it is called.
        make: builds a `milx.methods.base.Method` from a configuration and the sizes of what it sees and does.
        network: the class of its networks' settings.
        method: the class of its own settings.
        overrides: what it changes of every preset.

    Raises:
        ValueError: for a name that is taken.
    """
    _add(METHODS, "method", name, MethodEntry(make, network, method, overrides or {}))


def load_plugins() -> None:
    """Imports the packages that have an entry point in PLUGINS."""
    for plugin in importlib.metadata.entry_points(group=PLUGINS):
        plugin.load()


def _add(registry: dict[str, Any], kind: str, name: str, value: Any) -> None:
    if name in registry:
        raise ValueError(f"{kind}: {name!r} is registered already, expected a name that is free")
    registry[name] = value
