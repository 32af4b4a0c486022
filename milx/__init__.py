"""milx: one-shot visual imitation by meta-learning, end to end on the accelerator.

Importing milx does not change JAX's settings. The launchers call `configure` first, and your own scripts should do the
same.
"""

import importlib
from types import ModuleType

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


def __getattr__(name: str) -> ModuleType:
    """Imports `milx.gym`, which needs Gymnasium and MuJoCo, when it is first used."""
    if name == "gym":
        try:
            return importlib.import_module("milx.gym")
        except ModuleNotFoundError as error:
            raise ImportError(
                "milx.gym needs Gymnasium and MuJoCo: install milx with the extras 'gym' and 'sim'"
            ) from error
    raise AttributeError(f"module 'milx' has no attribute {name!r}")
