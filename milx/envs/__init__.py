"""Environments by name. They need MuJoCo, which is imported when the first of them is made."""

import importlib
from typing import TYPE_CHECKING, Any

from milx.config.registry import ENVS, register_env_at
from milx.config.schema import Config
from milx.envs.grasp.presets import GRASP
from milx.envs.place.presets import PLACE, PLACE_DURATIONS
from milx.envs.push.presets import PUSH, PUSH_DURATIONS
from milx.envs.reach.presets import REACH, REACH_DURATIONS, REACH_STATE

if TYPE_CHECKING:
    from milx.envs.base import Env, State, Task

__all__ = ["ENVS", "Env", "State", "Task", "make"]

register_env_at("reach", "milx.envs.reach.env:Reach", REACH, REACH_DURATIONS)
register_env_at("reach_state", "milx.envs.reach.env:ReachState", REACH_STATE)
register_env_at("push", "milx.envs.push.env:Push", PUSH, PUSH_DURATIONS)
register_env_at("place", "milx.envs.place.env:Place", PLACE, PLACE_DURATIONS)
register_env_at("grasp", "milx.envs.grasp.env:Grasp", GRASP)


def find(name: str) -> "type[Env]":
    """Finds the class of an environment.

    Raises:
        ValueError: for a name that does not exist (the message lists those that do), or if it needs MuJoCo and that is
            not installed.
    """
    if name not in ENVS:
        raise ValueError(f"env: got {name!r}, expected one of {', '.join(ENVS)}")
    return ENVS[name]


def of_config(config: Config) -> "Env":
    """Builds the environment of a configuration.

    Raises:
        ValueError: as `find` and `World.by_warp`.
    """
    env = make(config.env_name, config.env.image_shape, config.env.action_cost)
    if config.env.goal_step is not None:
        env.goal_step = config.env.goal_step
    return env.by_warp() if config.env.physics == "warp" else env


def make(name: str, image_shape: tuple[int, int] | None = None, action_cost: float | None = None) -> "Env":
    """Builds an environment.

    Args:
        name: a key of ENVS.
        image_shape: (H, W) in pixels; the published experiment's if None.
        action_cost: weight of the actions in the planner's cost; the environment's own if None.

    Raises:
        ValueError: as `find`.
    """
    env: Env = find(name)(image_shape)
    if action_cost is not None:
        env.action_cost = action_cost
    return env


def __getattr__(name: str) -> Any:
    """Imports what environments consist of when it is first used."""
    if name in ("Env", "State", "Task"):
        return getattr(importlib.import_module("milx.envs.base"), name)
    raise AttributeError(f"module 'milx.envs' has no attribute {name!r}")
