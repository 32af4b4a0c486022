"""The presets: hyperparameters of every experiment as published, for an accelerator, and for two CPU cores.

`make_config("reach", preset="paper")` gives a complete configuration.
"""

from collections.abc import Callable
from typing import Any

from milx.config import schema
from milx.config.schema import (
    Config,
    DataConfig,
    EnvConfig,
    EvalConfig,
    MILConfig,
    NetworkConfig,
    OptimizerConfig,
    TrainConfig,
)


def _reach_paper() -> Config:
    return Config(
        network=NetworkConfig(fc_norm=False),
        mil=MILConfig(inner_lr=0.03, whiten_actions=True),
        optimizer=_conditioned(),
        train=TrainConfig(steps=20_000, imitation_steps=2000, meta_batch=25),
    )


def _conditioned(learning_rate: float = 1e-3) -> OptimizerConfig:
    return OptimizerConfig(learning_rate=learning_rate, warmup=0.05, cosine=True, clip_norm=1.0)


def _reach_state_paper() -> Config:
    return _without_pixels(_reach_paper())


def _fast_mil() -> MILConfig:
    return MILConfig(inner_lr=0.03, learn_inner_lr=True, whiten_actions=True, goal_weight=1.0)


def _reach_fast() -> Config:
    return Config(
        network=NetworkConfig(
            strides=(2, 2, 1), soft_argmax=True, fc_layers=(200, 200), goal_head=True, mixed_precision=True
        ),
        mil=_fast_mil(),
        optimizer=_conditioned(),
        train=TrainConfig(steps=36_000, meta_batch=64, support_frames=3, query_frames=3, redraw=True),
    )


def _reach_cpu() -> Config:
    config = _reach_fast()
    config.env = EnvConfig(image_shape=(32, 40))
    config.data = DataConfig(tasks=300, demos_per_task=5, plan_iterations=8, plan_batch=100)
    config.network.mixed_precision = False
    config.network.filters = (32, 32, 32)
    config.network.fc_layers = (100, 100, 100)
    config.train = TrainConfig(
        steps=10_000, meta_batch=8, support_frames=3, query_frames=8, redraw=True, eval_every=2500
    )
    config.optimizer.learning_rate, config.optimizer.warmup = 2e-3, 0.02
    config.evaluation.validation_tasks = 25
    config.evaluation.baseline_trials = 1
    config.evaluation.batch = 25
    return config


def _reach_state_fast() -> Config:
    config = _without_pixels(_reach_fast())
    config.network.fc_layers = (200, 200, 200)
    config.train.steps = 20_000
    return config


def _reach_state_cpu() -> Config:
    config = _without_pixels(_reach_cpu())
    config.train.meta_batch = 32
    return config


def _push_paper() -> Config:
    return Config(
        env=EnvConfig(image_shape=(125, 125)),
        data=DataConfig(tasks=769, demos_per_task=12, noise=0.1, spare_demos=2, plan_iterations=0),
        network=NetworkConfig(
            filters=(16,) * 4,
            strides=(2,) * 4,
            kernel=5,
            soft_argmax=True,
            fc_layers=(200, 200, 200),
            fc_norm=False,
            bias_transformation=20,
            heads=2,
            mixed_precision=True,
        ),
        mil=MILConfig(inner_lr=0.03, inner_clip=10.0, whiten_actions=True),
        optimizer=_conditioned(),
        train=TrainConfig(steps=20_000, imitation_steps=2000, meta_batch=15),
        evaluation=EvalConfig(tasks=740, trials=6, baseline_trials=6, batch=185),
    )


def _push_fast() -> Config:
    config = _push_paper()
    config.network = NetworkConfig(
        filters=(32,) * 4,
        strides=(2, 2, 2, 1),
        kernel=5,
        mixed_precision=True,
        soft_argmax=True,
        fc_layers=(200, 200, 200),
        goal_head=True,
        bias_transformation=20,
    )
    config.mil = _fast_mil()
    config.optimizer = _conditioned(3e-3)
    config.train = TrainConfig(meta_batch=32, support_frames=4, query_frames=8, redraw=True)
    return config


def _push_cpu() -> Config:
    config = _push_fast()
    config.env = EnvConfig(image_shape=(48, 48))
    config.data.tasks, config.data.demos_per_task = 200, 6
    config.network.mixed_precision = False
    config.network.filters, config.network.kernel, config.network.strides = (16,) * 4, 3, (2, 2, 1, 1)
    config.train = TrainConfig(
        steps=10_000, meta_batch=8, support_frames=4, query_frames=8, redraw=True, log_every=25, eval_every=2500
    )
    config.evaluation = EvalConfig(validation_tasks=25, tasks=74, trials=6, baseline_trials=1, batch=25)
    return config


def _place_paper() -> Config:
    return Config(
        env=EnvConfig(image_shape=(90, 100)),
        data=DataConfig(tasks=150, demos_per_task=8, noise=0.2, plan_iterations=6),
        network=NetworkConfig(
            filters=(64,) * 5,
            strides=(2, 2, 2, 1, 1),
            fixed_filters="kmeans",
            soft_argmax=True,
            fc_layers=(100, 100, 100),
            fc_norm=False,
            mixed_precision=True,
            target_head=True,
            bias_transformation=20,
        ),
        mil=MILConfig(inner_steps=5, inner_lr=0.01, inner_clip=30.0, whiten_actions=True, goal_weight=1.0),
        optimizer=_conditioned(),
        train=TrainConfig(steps=20_000, imitation_steps=2000, meta_batch=12),
        evaluation=EvalConfig(tasks=180, trials=8, baseline_trials=8, batch=90),
    )


def _place_fast() -> Config:
    return Config(
        env=EnvConfig(image_shape=(90, 100)),
        data=DataConfig(tasks=150, demos_per_task=8, noise=0.2, plan_iterations=6),
        network=NetworkConfig(
            filters=(32,) * 4,
            strides=(2, 2, 1, 1),
            mixed_precision=True,
            soft_argmax=True,
            fc_layers=(200, 200, 200),
            goal_head=True,
            bias_transformation=20,
        ),
        mil=_fast_mil(),
        optimizer=_conditioned(3e-3),
        train=TrainConfig(meta_batch=32, support_frames=3, query_frames=8, redraw=True),
        evaluation=EvalConfig(tasks=180, trials=8, baseline_trials=8, batch=90),
    )


def _place_cpu() -> Config:
    config = _place_fast()
    config.env = EnvConfig(image_shape=(36, 40))
    config.data.plan_batch = 100
    config.network.filters, config.network.strides = (24,) * 3, (2, 1, 1)
    config.network.mixed_precision = False
    config.network.fc_layers = (100, 100, 100)
    config.train = TrainConfig(
        steps=10_000, meta_batch=8, support_frames=3, query_frames=8, redraw=True, eval_every=2500
    )
    config.evaluation = EvalConfig(validation_tasks=25, tasks=90, trials=8, baseline_trials=1, batch=25)
    return config


def _recorded_fast() -> Config:
    config = _push_fast()
    config.train.steps, config.train.eval_every, config.train.redraw = 10_000, 1000, False
    return config


def _recorded_cpu() -> Config:
    config = _recorded_fast()
    config.network.mixed_precision = False
    config.network.filters, config.network.kernel, config.network.strides = (16,) * 4, 3, (2, 2, 2, 1)
    config.network.fc_layers = (100, 100, 100)
    config.train.steps, config.train.meta_batch = 2000, 4
    config.train.log_every, config.train.eval_every = 50, 500
    return config


def _without_pixels(config: Config) -> Config:
    """No convolutions, but all time steps, which cost little now."""
    network = config.network
    network.filters = network.strides = ()
    network.soft_argmax = network.mixed_precision = False
    config.train.support_frames = config.train.query_frames = None
    return config


PRESETS: dict[str, dict[str, Callable[[], Config]]] = {
    "reach": {"paper": _reach_paper, "fast": _reach_fast, "cpu": _reach_cpu},
    "push": {"paper": _push_paper, "fast": _push_fast, "cpu": _push_cpu},
    "place": {"paper": _place_paper, "fast": _place_fast, "cpu": _place_cpu},
    "reach_state": {"paper": _reach_state_paper, "fast": _reach_state_fast, "cpu": _reach_state_cpu},
    "recorded": {"fast": _recorded_fast, "cpu": _recorded_cpu},
}
"""Preset factories by environment and name."""

SUPPORT_FRAMES = {"contextual": 1, "lstm": None, "lstm_attention": None}
"""Time steps of a demonstration shown to methods that do not imitate it: the last one, or all, as at test."""


def make_config(env: str, method: str = "mil", preset: str = "fast", seed: int = 0) -> Config:
    """The configuration of a preset.

    Raises:
        ValueError: for an environment or preset that does not exist; the message lists those that do.
    """
    if env not in PRESETS:
        raise ValueError(f"env: got {env!r}, expected one of {', '.join(PRESETS)}")
    if preset not in PRESETS[env]:
        raise ValueError(f"preset: got {preset!r}, expected one of {', '.join(PRESETS[env])}")
    config = PRESETS[env][preset]()
    config.env_name, config.method_name, config.preset, config.seed = env, method, preset, seed
    if method != "mil":
        config.train.support_frames = SUPPORT_FRAMES.get(method, config.train.support_frames)
        config.train.imitation_steps, config.network.heads = 0, 1  # there is no inner step
        config.network.target_head = False
    return config


def overrides(config: Config) -> dict[str, Any]:
    """The fields, by dotted name, in which a configuration differs from its preset."""
    preset = make_config(config.env_name, config.method_name, config.preset, config.seed)
    before, now = (schema.flatten(schema.to_dict(each)) for each in (preset, config))
    return {name: value for name, value in now.items() if value != before[name]}
