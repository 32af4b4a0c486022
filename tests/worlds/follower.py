"""A policy whose every action is known, the same episodes in this process, and interpreters that worlds run in."""

import pathlib
import sys

import jax.numpy as jnp
import numpy as np

from milx.config.assemble import make_config
from milx.data import RECORDED
from milx.deploy.policy import Policy
from milx.methods.base import Method
from milx.types import Spec
from milx.worlds.actor import other_tasks

WORLDS = pathlib.Path(__file__).parents[1] / "fixtures" / "worlds"
sys.path.insert(0, str(WORLDS))
import point_world  # noqa: E402


class Follower(Method):
    """Goes where a demonstration has ended, in steps of a fifth of the way that grow with every step."""

    def init(self, key, whitening):
        raise NotImplementedError

    def loss(self, params, batch, progress=1.0):
        raise NotImplementedError

    def adapt(self, params, demo):
        return demo.state[:, -1].mean(axis=0)

    def unadapted(self, params):
        return params["nowhere"]

    def act(self, task_params, observation, memory):
        return (task_params - observation.state) * jnp.minimum(0.2 + 0.1 * memory, 1.0), memory + 1

    def initial_memory(self, key):
        return jnp.zeros(())


def follower_policy():
    """Makes a policy that acts as Follower does."""
    config = make_config(RECORDED, preset="cpu")
    config.recorded.path, config.recorded.horizon = "somewhere", 6
    return Policy(Follower(), Spec(None, 2, 2, None, ()), {"nowhere": jnp.zeros(2)}, config)


def alone(tasks, episode, demo_seed):
    """Runs an episode without workers and batches; returns whether the task was done at any time, and at last.

    Args:
        tasks: those with demonstrations may stand in for each other.
        episode: which.
        demo_seed: of the demonstrations of all tasks.
    """
    control, number, seed = episode
    env = point_world.PointWorld(tasks[number].name)
    shown = point_world.PointWorld(tasks[number].name).demonstrate(demo_seed)
    source = other_tasks(tasks, number)[control] if control in ("same_family", "other_family") else number
    goal = point_world.PointWorld(tasks[source].name).demonstrate(demo_seed)["state"][-1]
    goal = np.zeros(2) if control == "unadapted" else goal
    env.action_space.seed(seed)
    position, _ = env.reset(seed=seed)
    done = []
    for step in range(point_world.LENGTH):
        action = {
            "replay": shown["action"][step],
            "mean_action": shown["action"].mean(axis=0),
            "random": env.action_space.sample(),
        }.get(control, (goal - position) * min(0.2 + 0.1 * step, 1.0))
        position, _, _, _, info = env.step(np.clip(action, -0.5, 0.5))
        done.append(bool(info["is_success"]))
    return any(done), done[-1]


def interpreter(path, first):
    """Writes an interpreter at a path that does some lines of shell and then is this one; returns the path as text."""
    path.write_text(f'#!/bin/sh\n{first}\nexec "{sys.executable}" "$@"\n')
    path.chmod(0o755)
    return str(path)
