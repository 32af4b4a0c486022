"""Settings that the presets of several environments share."""

from milx.config.registry import Overrides

CONDITIONED: Overrides = {
    "optimizer.learning_rate": 1e-3,
    "optimizer.warmup": 0.05,
    "optimizer.cosine": True,
    "optimizer.clip_norm": 1.0,
}
"""Settings of the meta-optimizer: a warm-up, a cosine decay and a bound on the norm of the meta-gradient."""

GOAL_HEAD: Overrides = {
    "network.goal_head": True,
    "method.goal_weight": 1.0,
    "method.inner_lr": 0.03,
    "method.learn_inner_lr": True,
    "method.whiten_actions": True,
}
"""milx's goal head, and the settings of the loss and of the inner step that it is used with."""

WITHOUT_PIXELS: Overrides = {
    "network.filters": (),
    "network.strides": (),
    "network.soft_argmax": False,
    "network.mixed_precision": False,
    "train.support_frames": None,
    "train.query_frames": None,
}
"""No convolutions. All time steps are used, because they cost little without images."""
