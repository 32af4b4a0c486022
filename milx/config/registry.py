"""Environments, methods and presets by name: milx's own, and those that other packages register.

Your package registers its environments and methods when it is imported. The launchers import every package that has an
entry point in the group "milx.plugins":

    [project.entry-points."milx.plugins"]
    mine = "my_package"
"""

import collections
import importlib.metadata
import pkgutil
import warnings
from collections.abc import Callable, MutableMapping
from typing import Any, NamedTuple

from milx.config.schema import Config, MethodConfig, NetworkConfig
from milx.types import Spec

PLUGINS = "milx.plugins"
"""The entry-point group of packages that extend milx."""

Overrides = dict[str, Any]
"""Values of a configuration's fields, by dotted name."""


class MethodEntry(NamedTuple):
    """A registered method.

    Attributes:
        make: builds the method from a configuration and the sizes of observations and actions.
        network: the class of `Config.network`.
        method: the class of `Config.method`.
        overrides: values that replace those of every preset.
    """

    make: Callable[[Config, Spec], Any]
    network: type[NetworkConfig]
    method: type[MethodConfig]
    overrides: Overrides


class _Classes(collections.UserDict[str, Any]):
    """Classes by name; one that is registered as "module:class" is imported when it is first asked for."""

    def __getitem__(self, name: str) -> Any:
        found = super().__getitem__(name)
        if isinstance(found, str):
            try:
                self[name] = found = pkgutil.resolve_name(found)
            except ModuleNotFoundError as error:
                if error.name != "mujoco":
                    raise
                raise ValueError(f"env: {name!r} needs MuJoCo: install milx with the extra 'sim'") from error
        return found


ENVS: MutableMapping[str, Any] = _Classes()
"""Classes of environments by name. They are called with an image shape (H, W) or None."""
METHODS: dict[str, MethodEntry] = {}
PRESETS: dict[str, dict[str, Overrides]] = {}
"""Presets by environment and name: the values in which they differ from the defaults.

Fields that a method does not have are ignored."""
DURATIONS: dict[str, dict[str, str]] = {}
"""How long a run took and on what hardware, in words, by environment and preset; measured for MIL only."""


def register_env(env: Any, presets: dict[str, Overrides], durations: dict[str, str] | None = None) -> None:
    """Makes an environment available to `milx.make` and `--env`.

    Args:
        env: a subclass of `milx.envs.base.Env`; it is registered under its attribute `name`.
        presets: by name. Launchers use "fast" by default with an accelerator, and "cpu" without one.
        durations: by preset, how long a run of MIL took and on what hardware; launchers say so.

    Raises:
        ValueError: if the name is already registered.
    """
    register_env_at(env.name, env, presets, durations)


def register_env_at(
    name: str, where: Any, presets: dict[str, Overrides], durations: dict[str, str] | None = None
) -> None:
    """Registers an environment as `register_env` does, by its name and its class or the place of that, "module:class".

    Raises:
        ValueError: if the name is already registered.
    """
    _add(ENVS, "env", name, where)
    register_presets(name, presets)
    DURATIONS[name] = durations or {}


def register_presets(env: str, presets: dict[str, Overrides]) -> None:
    """Registers the presets of an environment.

    Raises:
        ValueError: if the environment already has presets.
    """
    _add(PRESETS, "presets", env, presets)


def register_method(
    name: str,
    make: Callable[[Config, Spec], Any],
    network: type[NetworkConfig] = NetworkConfig,
    method: type[MethodConfig] = MethodConfig,
    overrides: Overrides | None = None,
) -> None:
    """Makes a method available to `--method`.

    Args:
        name: the method's name.
        make: builds a `milx.methods.base.Method` from a configuration and the sizes of observations and actions.
        network: the class of its networks' settings.
        method: the class of its own settings.
        overrides: values that replace those of every preset.

    Raises:
        ValueError: if the name is already registered.
    """
    _add(METHODS, "method", name, MethodEntry(make, network, method, overrides or {}))


def load_plugins() -> None:
    """Imports the packages that have an entry point in the group PLUGINS.

    Warns:
        RuntimeWarning: if one of them cannot be imported; milx goes on without it.
    """
    for plugin in importlib.metadata.entry_points(group=PLUGINS):
        try:
            plugin.load()
        except Exception as error:  # whatever a package does wrong, milx's own environments and methods work
            warnings.warn(f"plugin {plugin.name} = {plugin.value}: {error!r}", RuntimeWarning, stacklevel=2)


def _add(registry: MutableMapping[str, Any], kind: str, name: str, value: Any) -> None:
    if name in registry:
        raise ValueError(f"{kind}: {name!r} is registered already, expected a name that is free")
    registry[name] = value
