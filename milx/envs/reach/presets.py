"""Presets of reach from pixels (1,500 tasks, 15,000 demonstrations) and from states."""

from milx.config.presets import CONDITIONED, GOAL_HEAD, WITHOUT_PIXELS
from milx.config.registry import Overrides

_PAPER: Overrides = CONDITIONED | {
    "network.fc_norm": False,
    "method.inner_lr": 0.03,
    "method.whiten_actions": True,
    "method.imitation_steps": 2000,
    "train.steps": 20_000,
    "train.meta_batch": 25,
}
_FAST = (
    CONDITIONED
    | GOAL_HEAD
    | {
        "network.strides": (2, 2, 1),
        "network.soft_argmax": True,
        "network.fc_layers": (200, 200),
        "network.mixed_precision": True,
        "data.plan_iterations": 4,
        "train.steps": 12_000,
        "train.meta_batch": 64,
        "train.support_frames": 3,
        "train.query_frames": 3,
        "train.frame_exponent": 2.0,
        "train.redraw": True,
        "train.eval_every": 4000,
    }
)
_SMALL = _FAST | {
    "env.image_shape": (32, 40),
    "data.tasks": 300,
    "data.demos_per_task": 5,
    "data.plan_batch": 100,
    "network.filters": (32, 32, 32),
    "network.fc_layers": (100, 100, 100),
    "network.mixed_precision": False,
    "optimizer.learning_rate": 2e-3,
    "optimizer.warmup": 0.02,
    "train.steps": 10_000,
    "train.meta_batch": 8,
    "train.query_frames": 8,
    "train.eval_every": 2500,
    "evaluation.validation_tasks": 25,
    "evaluation.baseline_trials": 1,
    "evaluation.batch": 25,
}
_CPU = _SMALL | {
    "optimizer.name": "muon",
    "method.sharpness": 4.0,
    "train.steps": 4000,
    "train.query_frames": 4,
    "train.eval_every": 2000,
}

REACH: dict[str, Overrides] = {"paper": _PAPER, "fast": _FAST, "cpu": _CPU}
REACH_DURATIONS = {
    "paper": "9 to 12 minutes on an H200 that another run used, too",
    "fast": "3 minutes on an H100",
    "cpu": "4 minutes on two CPU cores",
}
REACH_STATE: dict[str, Overrides] = {
    "paper": _PAPER | WITHOUT_PIXELS,
    "fast": _FAST | WITHOUT_PIXELS | {"network.fc_layers": (200, 200, 200), "train.steps": 20_000},
    "cpu": _SMALL | WITHOUT_PIXELS | {"train.meta_batch": 32},
}
