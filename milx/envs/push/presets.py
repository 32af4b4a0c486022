"""Presets of push, and of recorded demonstrations, which begin with those of push."""

from milx.config.presets import CONDITIONED, GOAL_HEAD
from milx.config.registry import Overrides

_WORLD: Overrides = {
    "env.image_shape": (125, 125),
    "data.tasks": 769,
    "data.demos_per_task": 12,
    "data.noise": 0.1,
    "data.spare_demos": 2,
    "data.expert": "pretrained",
    "evaluation.tasks": 740,
    "evaluation.trials": 6,
    "evaluation.baseline_trials": 6,
    "evaluation.batch": 185,
}
_PAPER = (
    CONDITIONED
    | _WORLD
    | {
        "network.filters": (16, 16, 16, 16),
        "network.strides": (2, 2, 2, 2),
        "network.kernel": 5,
        "network.soft_argmax": True,
        "network.fc_layers": (200, 200, 200),
        "network.fc_norm": False,
        "network.bias_transformation": 20,
        "network.heads": 2,
        "network.mixed_precision": True,
        "method.inner_lr": 0.03,
        "method.inner_clip": 10.0,
        "method.whiten_actions": True,
        "method.imitation_steps": 2000,
        "optimizer.name": "muon",  # Adam needs 2,000 to 8,000 updates until the policy listens
        "train.steps": 20_000,
        "train.meta_batch": 15,
    }
)
_FAST = (
    CONDITIONED
    | GOAL_HEAD
    | _WORLD
    | {
        "env.goal_step": 20,
        "network.filters": (32, 32, 32, 32),
        "network.strides": (2, 2, 2, 1),
        "network.kernel": 5,
        "network.mixed_precision": True,
        "network.soft_argmax": True,
        "network.fc_layers": (200, 200, 200),
        "network.bias_transformation": 20,
        "optimizer.learning_rate": 3e-3,
        "train.meta_batch": 32,
        "train.support_frames": 4,
        "train.query_frames": 8,
        "train.frame_exponent": 2.0,
        "train.redraw": True,
    }
)
_CPU = _FAST | {
    "env.image_shape": (48, 48),
    "data.tasks": 1200,
    "data.demos_per_task": 2,
    "data.noise": 0.3,
    "data.plan_batch": 100,
    "network.filters": (16, 16, 16, 16),
    "network.kernel": 3,
    "network.strides": (2, 2, 1, 1),
    "network.mixed_precision": False,
    "method.sharpness": 4.0,
    "optimizer.name": "muon",
    "optimizer.learning_rate": 1.5e-3,
    "train.steps": 7500,
    "train.meta_batch": 8,
    "train.log_every": 25,
    "train.eval_every": 3750,
    "evaluation.validation_tasks": 25,
    "evaluation.tasks": 74,
    "evaluation.baseline_trials": 1,
    "evaluation.batch": 25,
}

PUSH: dict[str, Overrides] = {"paper": _PAPER, "fast": _FAST, "cpu": _CPU}
PUSH_DURATIONS = {
    "paper": "7 minutes on an H200",
    "fast": "6 minutes on an H200",
    "cpu": "20 minutes on two CPU cores",
}
