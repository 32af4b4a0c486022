"""Environments, methods and presets by name: milx's own, and those that other packages register.

Your package registers its environments and methods when it is imported. The launchers import every package that has an
entry point in the group "milx.plugins":

    [project.entry-points."milx.plugins"]
    mine = "my_package"
"""

import importlib
import importlib.metadata
import pkgutil
import warnings
from collections.abc import Callable, Iterator, MutableMapping
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


_OWN = ("milx.envs", "milx.methods", "milx.data")
"""Packages that register what milx itself brings."""


class _Registry(MutableMapping[str, Any]):
    """What is registered, by name. What milx itself brings is imported when something is looked up.

    A package that is just being imported looks up whether its names are free. Python then returns to it at once, and
    lets other threads wait until it is imported.
    """

    def __init__(self) -> None:
        self._registered: dict[str, Any] = {}

    @property
    def _entries(self) -> dict[str, Any]:
        for package in _OWN:
            importlib.import_module(package)
        return self._registered

    def __getitem__(self, name: str) -> Any:
        return self._entries[name]

    def __setitem__(self, name: str, value: Any) -> None:
        self._registered[name] = value

    def __delitem__(self, name: str) -> None:
        del self._registered[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)


class _Classes(_Registry):
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
METHODS: MutableMapping[str, MethodEntry] = _Registry()
PRESETS: MutableMapping[str, dict[str, Overrides]] = _Registry()
"""Presets by environment and name: the values in which they differ from the defaults.

Fields that a method does not have are ignored."""
DURATIONS: MutableMapping[str, dict[str, str]] = _Registry()
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
