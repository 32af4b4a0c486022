"""Environments by name."""

from milx.config.registry import ENVS, register_env
from milx.envs.base import Env, State, Task
from milx.envs.place.env import Place
from milx.envs.place.presets import PLACE, PLACE_DURATIONS
from milx.envs.push.env import Push
from milx.envs.push.presets import PUSH, PUSH_DURATIONS
from milx.envs.reach.env import Reach, ReachState
from milx.envs.reach.presets import REACH, REACH_DURATIONS, REACH_STATE

__all__ = ["ENVS", "Env", "State", "Task", "make"]

register_env(Reach, REACH, REACH_DURATIONS)
register_env(ReachState, REACH_STATE)
register_env(Push, PUSH, PUSH_DURATIONS)
register_env(Place, PLACE, PLACE_DURATIONS)


def make(name: str, image_shape: tuple[int, int] | None = None, action_cost: float | None = None) -> Env:
    """Builds an environment.

    Args:
        name: a key of ENVS.
        image_shape: (H, W) in pixels; the published experiment's if None.
        action_cost: weight of the actions in the planner's cost; the environment's own if None.

    Raises:
        ValueError: for a name that does not exist; the message lists those that do.
    """
    if name not in ENVS:
        raise ValueError(f"env: got {name!r}, expected one of {', '.join(ENVS)}")
    env: Env = ENVS[name](image_shape)
    if action_cost is not None:
        env.action_cost = action_cost
    return env
