"""milx: one-shot visual imitation by meta-learning, end to end on the accelerator.

Importing milx does not change JAX's settings. The launchers call `configure` first, and your own scripts should do the
same.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from milx.config.registry import register_env, register_method
    from milx.core.platform import configure
    from milx.deploy.policy import Policy
    from milx.deploy.pretrained import load
    from milx.envs import ENVS, make
    from milx.methods import METHODS
    from milx.types import Demo, Observation
    from milx.worlds.evaluate import evaluate_in

__version__ = "0.1.0"
__all__ = [
    "ENVS",
    "METHODS",
    "Demo",
    "Observation",
    "Policy",
    "__version__",
    "configure",
    "evaluate_in",
    "load",
    "make",
    "register_env",
    "register_method",
]


_HOMES = {
    "ENVS": "milx.config.registry",
    "METHODS": "milx.config.registry",
    "Demo": "milx.types",
    "Observation": "milx.types",
    "Policy": "milx.deploy.policy",
    "configure": "milx.core.platform",
    "evaluate_in": "milx.worlds.evaluate",
    "load": "milx.deploy.pretrained",
    "make": "milx.envs",
    "register_env": "milx.config.registry",
    "register_method": "milx.config.registry",
}
"""Where the names above are defined."""
_PACKAGES = (
    "config",
    "core",
    "data",
    "deploy",
    "envs",
    "evaluation",
    "meta",
    "methods",
    "networks",
    "render",
    "types",
    "worlds",
)
"""Packages and modules that are attributes of milx without an import of their own."""


def __getattr__(name: str) -> Any:
    """Imports what a name needs when it is first used, so that a part of milx does not import the others.

    `milx.gym` needs Gymnasium and MuJoCo.
    """
    if name in _HOMES:
        globals()[name] = found = getattr(importlib.import_module(_HOMES[name]), name)
        return found
    if name in _PACKAGES:
        return importlib.import_module(f"milx.{name}")
    if name == "gym":
        try:
            return importlib.import_module("milx.gym")
        except ModuleNotFoundError as error:
            raise ImportError(
                "milx.gym needs Gymnasium and MuJoCo: install milx with the extras 'gym' and 'sim'"
            ) from error
    raise AttributeError(f"module 'milx' has no attribute {name!r}")


def __dir__() -> list[str]:
    """Lists the names above, imported or not."""
    return sorted({*globals(), *__all__})
