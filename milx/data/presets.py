"""Presets of recorded demonstrations: those of push, whose images are the largest, with fewer updates.

Time steps, kernels and learning rate of `fast` are those of policies that did well on Meta-World; the time steps have
been compared with others there (docs/results/meta_world.md).
"""

from milx.config.registry import Overrides
from milx.envs.push.presets import PUSH

_FAST = PUSH["fast"] | {
    "env.goal_step": None,
    "train.steps": 10_000,
    "train.eval_every": 1000,
    "train.frame_exponent": 1.0,
    "train.redraw": False,
}
_METAWORLD = {
    "network.kernel": 3,
    "optimizer.learning_rate": 1e-3,
    "train.support_frames": 10,
    "train.query_frames": 12,
}
RECORDED_PRESETS: dict[str, Overrides] = {
    "fast": _FAST | _METAWORLD,
    "cpu": _FAST
    | {
        "network.filters": (16, 16, 16, 16),
        "network.kernel": 3,
        "network.strides": (2, 2, 2, 1),
        "network.fc_layers": (100, 100, 100),
        "network.mixed_precision": False,
        "train.steps": 2000,
        "train.meta_batch": 4,
        "train.log_every": 50,
        "train.eval_every": 500,
    },
}
