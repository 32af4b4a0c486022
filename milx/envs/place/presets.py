"""Presets of place."""

from milx.config.presets import CONDITIONED, GOAL_HEAD
from milx.config.registry import Overrides

_WORLD: Overrides = {
    "env.image_shape": (90, 100),
    "data.tasks": 150,
    "data.demos_per_task": 8,
    "data.noise": 0.2,
    "data.plan_iterations": 6,
    "evaluation.tasks": 180,
    "evaluation.trials": 8,
    "evaluation.baseline_trials": 8,
    "evaluation.batch": 90,
}
_PAPER = (
    CONDITIONED
    | _WORLD
    | {
        "data.tasks": 12_000,
        "data.demos_per_task": 2,
        "network.filters": (64, 64, 64, 64, 64),
        "network.strides": (2, 2, 2, 1, 1),
        "network.fixed_filters": "kmeans",
        "network.soft_argmax": True,
        "network.fc_layers": (100, 100, 100),
        "network.fc_norm": False,
        "network.mixed_precision": True,
        "network.target_head": True,
        "network.bias_transformation": 20,
        "method.inner_steps": 5,
        "method.inner_lr": 0.01,
        "method.inner_clip": 30.0,
        "method.whiten_actions": True,
        "method.goal_weight": 1.0,
        "method.imitation_steps": 2000,
        "train.steps": 20_000,
        "train.meta_batch": 12,
    }
)
_FAST = (
    CONDITIONED
    | GOAL_HEAD
    | _WORLD
    | {
        "network.filters": (32, 32, 32, 32),
        "network.strides": (2, 2, 1, 1),
        "network.mixed_precision": True,
        "network.soft_argmax": True,
        "network.fc_layers": (200, 200, 200),
        "network.bias_transformation": 20,
        "optimizer.learning_rate": 3e-3,
        "train.meta_batch": 32,
        "train.support_frames": 3,
        "train.query_frames": 8,
        "train.redraw": True,
    }
)
_CPU = _FAST | {
    "env.image_shape": (36, 40),
    "data.demos_per_task": 4,
    "data.plan_iterations": 4,
    "data.plan_batch": 100,
    "network.filters": (24, 24, 24),
    "network.strides": (2, 1, 1),
    "network.mixed_precision": False,
    "network.fc_layers": (100, 100, 100),
    "method.sharpness": 4.0,
    "optimizer.name": "muon",
    "train.steps": 5000,
    "train.meta_batch": 8,
    "train.support_frames": 2,
    "train.query_frames": 4,
    "train.eval_every": 2500,
    "evaluation.validation_tasks": 25,
    "evaluation.tasks": 90,
    "evaluation.baseline_trials": 1,
    "evaluation.batch": 25,
}

PLACE: dict[str, Overrides] = {"paper": _PAPER, "fast": _FAST, "cpu": _CPU}
PLACE_DURATIONS = {
    "paper": "18 minutes on an H100",
    "fast": "6.6 minutes on an H200 that another run used, too",
    "cpu": "10 minutes on two CPU cores",
}
