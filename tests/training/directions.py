"""Recorded demonstrations of tasks with a known answer, each a direction, and a small run on them."""

import dataclasses

import numpy as np

from milx.data.dataset import Writer
from milx.training import recorded
from milx.types import Demo

HORIZON = 8
MEAN, SPREAD = np.array([3.0, -1.0]), np.array([2.0, 0.1])
"""Of the actions, of very different sizes."""


def random_demo(rng, direction, length):
    """Draws images of a task's color, and actions along its direction and on the state."""
    state = rng.normal(size=(length, 3)).astype(np.float32)
    color = np.uint8(128 + 100 * np.append(direction, 0.0))
    image = np.broadcast_to(color, (length, 12, 16, 3))
    action = MEAN + SPREAD * (1.5 * direction + 0.5 * state[:, :2])
    return Demo(image, state, action.astype(np.float32))


def write_directions(folder):
    """Writes 40 tasks, each a direction, with 3 demonstrations of 7 to 12 steps."""
    rng = np.random.default_rng(0)
    with Writer(folder, (12, 16), 3, 2, "a test") as writer:
        for task in range(40):
            angle = rng.uniform(0, 2 * np.pi)
            direction = np.array([np.cos(angle), np.sin(angle)])
            demos = [random_demo(rng, direction, length) for length in rng.integers(7, 13, 3)]
            split = "validation" if task < 4 else "test" if task < 10 else "train"
            writer.add(f"direction {task}", split, [len(demo.state) for demo in demos], demos)
    return folder


def tiny_config(folder):
    config = recorded.config_for(folder, preset="cpu")
    config.recorded.horizon = HORIZON
    config.network.filters, config.network.strides, config.network.fc_layers = (4, 4), (2, 1), (40, 40)
    config.train.steps, config.train.log_every, config.train.eval_every = 300, 50, 100
    config.train.meta_batch, config.optimizer.learning_rate = 8, 6e-3
    return config


def write_tasks(folder, change, action_size=2):
    """Writes six tasks for training and two for each other split, after a change of every demonstration's action."""
    rng = np.random.default_rng(0)
    with Writer(folder, (12, 16), 3, action_size, "a test") as writer:
        for task, split in enumerate(["train"] * 6 + ["validation", "test"] * 2):
            demos = [random_demo(rng, np.array([0.6, 0.8]), 7) for _ in range(2)]
            demos = [dataclasses.replace(demo, action=change(demo.action)) for demo in demos]
            writer.add(f"task {task}", split, [7, 7], demos)
    return folder
