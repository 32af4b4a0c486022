"""Every hyperparameter, as plain dataclasses, and the presets that fill them.

`make_config("reach", preset="paper")` gives a complete configuration; a launcher's `--config.path.to.field=value`
overrides one field of it.
"""

import dataclasses
import functools
import typing
from collections.abc import Callable
from typing import Any

from milx import validate

GIVEN = ("video+state+action", "video+state", "video")
"""What a demonstration can show of a new task."""


@dataclasses.dataclass
class EnvConfig:
    """The world.

    Attributes:
        image_shape: (H, W) of the policy's image in pixels.
    """

    image_shape: tuple[int, int] = (64, 80)


@dataclasses.dataclass
class DataConfig:
    """Expert demonstrations.

    Attributes:
        tasks: training tasks.
        demos_per_task: demonstrations of each, in different scenes.
        noise: standard deviation of the Gaussian noise on the expert's actions, in units of the action.
        spare_demos: demonstrations of validation and test tasks beyond those that are shown, in place of failed ones.
        plan_iterations: most iterations of trajectory optimisation for a demonstration; 0 for the environment's
            controller instead.
        plan_batch: demonstrations planned at once.
    """

    tasks: int = 1500
    demos_per_task: int = 10
    noise: float = 0.01
    spare_demos: int = 0
    plan_iterations: int = 16
    plan_batch: int = 4096


@dataclasses.dataclass
class RecordedConfig:
    """Recorded demonstrations, instead of an environment (`milx.data.dataset`).

    Attributes:
        path: the data set's folder.
        horizon: time steps that every demonstration is resampled to.
        goal_indices: entries of the state that tell where the robot is: a goal head predicts where they end.
        gib: room on the device for what a scan draws its batches from, in GiB; the next scan's is loaded meanwhile.
    """

    path: str = ""
    horizon: int = 50
    goal_indices: tuple[int, ...] = ()
    gib: float = 2.0


@dataclasses.dataclass
class NetworkConfig:
    """The policy network.

    Attributes:
        filters: output channels of each convolution.
        strides: stride of each convolution.
        kernel: height and width of every kernel.
        fixed_filters: the first convolution is given and never learned: "kmeans" for a bank of the training images, or
            a file with VGG-19's first layer (`milx.networks.fixed`); None for one that is learned.
        mixed_precision: convolve in bfloat16; parameters, norms and all other layers stay in float32.
        rematerialise: keep only the inputs of each convolution for the backward pass and compute the rest a second
            time: less memory, more time, the same results.
        soft_argmax: spatial soft-argmax after the last convolution, with a learned temperature; flattened otherwise.
        fc_layers: sizes of the hidden fully connected layers.
        fc_norm: layer norm in the hidden fully connected layers.
        fc_init_std: standard deviation of their first weights; None for LeCun's initialisation.
        bias_transformation: size of the learned vector beside the first fully connected layer's input; 0 for none.
        heads: 1, or 2 for a separate output layer in the inner loss.
        goal_head: predict where the episode ends, from the image, or from the state where the policy sees no pixels,
            and show the prediction to the layers after it (`milx.networks.goal`).
        learned_loss: MIL's inner loss where demonstrations show no actions (`mil.given`): "linear", or "temporal" with
            convolutions over time (`milx.networks.learned_loss`); None where they show them.
        context: size of the vector that methods without adaptation keep of a demonstration: units of the LSTM.
        context_frames: time steps of a demonstration that an LSTM reads.
    """

    filters: tuple[int, ...] = (40, 40, 40)
    strides: tuple[int, ...] = (2, 2, 2)
    kernel: int = 3
    fixed_filters: str | None = None
    mixed_precision: bool = False
    rematerialise: bool = False
    soft_argmax: bool = False
    fc_layers: tuple[int, ...] = (200, 200, 200, 200)
    fc_norm: bool = True
    fc_init_std: float | None = None
    bias_transformation: int = 10
    heads: int = 1
    goal_head: bool = False
    learned_loss: str | None = None
    context: int = 512
    context_frames: int = 10


@dataclasses.dataclass
class MILConfig:
    """Meta-imitation learning (paper, Section 4); the last four hold for all methods.

    Attributes:
        inner_steps: gradient steps of an adaptation.
        inner_lr: their learning rate alpha.
        learn_inner_lr: meta-learn a factor on alpha for every tensor.
        inner_clip: bound on each entry of the inner gradient.
        first_order: do not differentiate through the inner gradient.
        loss_scale: m; errors of the actions are multiplied by it before they are squared.
        whiten_actions: let the network predict actions with zero mean and unit variance.
        goal_weight: weight of the goal head's negative log likelihoods.
        given: what a policy is shown of a new task: one of GIVEN. Queries, in meta-training, show everything.
    """

    inner_steps: int = 1
    inner_lr: float = 1e-3
    learn_inner_lr: bool = False
    inner_clip: float = 20.0
    first_order: bool = False
    loss_scale: float = 1.0
    whiten_actions: bool = False
    goal_weight: float = 0.0
    given: str = "video+state+action"


@dataclasses.dataclass
class OptimizerConfig:
    """Adam on the meta-objective.

    Attributes:
        learning_rate: its peak.
        warmup: part of the run that warms up linearly from zero.
        cosine: decay to zero along a cosine over the run; constant otherwise.
        clip_norm: bound on the global norm of the meta-gradient; None for none.
    """

    learning_rate: float = 1e-3
    warmup: float = 0.0
    cosine: bool = False
    clip_norm: float | None = None


@dataclasses.dataclass
class TrainConfig:
    """The meta-training loop.

    Attributes:
        steps: meta-updates.
        meta_batch: tasks in a meta-batch.
        shots: support demonstrations of each task.
        support_frames: time steps drawn from each support demonstration; None for all.
        query_frames: time steps drawn from each query demonstration; None for all.
        redraw: whenever a task is drawn, show it in new colours of the training split, and its demonstrations among
            distractors in new places: few planned demonstrations stand for many tasks and scenes.
        log_every: meta-updates in one scan on the device.
        eval_every: meta-updates between two validations; each is followed by a checkpoint.
    """

    steps: int = 30_000
    meta_batch: int = 5
    shots: int = 1
    support_frames: int | None = None
    query_frames: int | None = None
    redraw: bool = False
    log_every: int = 100
    eval_every: int = 2000


@dataclasses.dataclass
class EvalConfig:
    """Closed-loop evaluation.

    Attributes:
        validation_tasks: held-out tasks for choosing the best checkpoint.
        tasks: held-out tasks of the reported number.
        trials: scenes tried for each task.
        baseline_trials: in how many of those scenes the experts and random actions are tried, too.
        shots: demonstrations that the policy adapts to.
        batch: tasks rolled out at once.
    """

    validation_tasks: int = 100
    tasks: int = 150
    trials: int = 10
    baseline_trials: int = 10
    shots: int = 1
    batch: int = 150


@dataclasses.dataclass
class Config:
    """A whole run."""

    env_name: str = "reach"
    method_name: str = "mil"
    preset: str = "paper"
    seed: int = 0
    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    data: DataConfig = dataclasses.field(default_factory=DataConfig)
    recorded: RecordedConfig = dataclasses.field(default_factory=RecordedConfig)
    network: NetworkConfig = dataclasses.field(default_factory=NetworkConfig)
    mil: MILConfig = dataclasses.field(default_factory=MILConfig)
    optimizer: OptimizerConfig = dataclasses.field(default_factory=OptimizerConfig)
    train: TrainConfig = dataclasses.field(default_factory=TrainConfig)
    evaluation: EvalConfig = dataclasses.field(default_factory=EvalConfig)


def _reach_paper() -> Config:
    return Config(
        network=NetworkConfig(fc_norm=False, fc_init_std=0.01),
        mil=MILConfig(loss_scale=100.0),
    )


def _reach_fast() -> Config:
    return Config(
        network=NetworkConfig(
            strides=(2, 2, 1), soft_argmax=True, fc_layers=(200, 200), goal_head=True, mixed_precision=True
        ),
        mil=MILConfig(inner_lr=0.03, learn_inner_lr=True, whiten_actions=True, goal_weight=1.0),
        optimizer=OptimizerConfig(warmup=0.05, cosine=True, clip_norm=1.0),
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
            fc_init_std=0.01,
            bias_transformation=20,
            heads=2,
        ),
        mil=MILConfig(inner_lr=0.01, inner_clip=10.0, loss_scale=50.0),
        train=TrainConfig(meta_batch=15),
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
    config.mil = MILConfig(inner_lr=0.03, learn_inner_lr=True, whiten_actions=True, goal_weight=1.0)
    config.optimizer = OptimizerConfig(learning_rate=3e-3, warmup=0.05, cosine=True, clip_norm=1.0)
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
            fc_init_std=0.01,
            goal_head=True,
            bias_transformation=20,
        ),
        mil=MILConfig(inner_steps=5, inner_lr=0.005, inner_clip=30.0, loss_scale=50.0, goal_weight=1.0),
        train=TrainConfig(steps=50_000, meta_batch=12),
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
        mil=MILConfig(inner_lr=0.03, learn_inner_lr=True, whiten_actions=True, goal_weight=1.0),
        optimizer=OptimizerConfig(learning_rate=3e-3, warmup=0.05, cosine=True, clip_norm=1.0),
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
    "reach_state": {"fast": _reach_state_fast, "cpu": _reach_state_cpu},
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
    config.train.support_frames = SUPPORT_FRAMES.get(method, config.train.support_frames)
    return config


def to_dict(config: Config) -> dict[str, Any]:
    """The configuration as nested dictionaries that JSON can hold."""
    return dataclasses.asdict(config)


def from_dict(values: dict[str, Any]) -> Config:
    """The inverse of `to_dict`, also after a trip through JSON.

    Raises:
        ValueError: for a field that does not exist (the message lists those that do), or has a value that it cannot.
    """
    config = _build(Config, values, "config")
    validate.check(config)
    return config


def flatten(values: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested dictionaries as one, with dotted names."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return flat


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Where two configurations of `to_dict` differ, a line each."""
    before, after = flatten(old), flatten(new)
    return [f"{name} was {before[name]}, now {after[name]}" for name in before if before[name] != after[name]]


def assign(config: Config, field: str, value: Any) -> None:
    """Sets the field with this dotted name.

    Raises:
        ValueError: if there is no such field, or the value is None and the field cannot be.
    """
    if field not in flatten(to_dict(config)):
        raise ValueError(f"config.{field}: no such field")
    *path, name = field.split(".")
    holder: Any = functools.reduce(getattr, path, config)
    if value is None and type(None) not in typing.get_args(typing.get_type_hints(type(holder))[name]):
        raise ValueError(f"config.{field}: got None, expected a value")
    setattr(holder, name, value)


def overrides(config: Config) -> dict[str, Any]:
    """The fields, by dotted name, in which a configuration differs from its preset."""
    preset = flatten(to_dict(make_config(config.env_name, config.method_name, config.preset, config.seed)))
    return {name: value for name, value in flatten(to_dict(config)).items() if value != preset[name]}


def _build(cls: type, values: dict[str, Any], path: str) -> Any:
    types = typing.get_type_hints(cls)
    if not isinstance(values, dict) or not all(isinstance(name, str) for name in values):
        raise ValueError(f"{path}: got {values!r}, expected a group of fields")
    unknown = sorted(set(values) - set(types))
    if unknown:
        raise ValueError(f"{path}.{unknown[0]}: no such field, expected one of {', '.join(types)}")
    built = {}
    for name, value in values.items():
        if dataclasses.is_dataclass(types[name]):
            value = _build(typing.cast(type, types[name]), value, f"{path}.{name}")
        built[name] = tuple(value) if isinstance(value, list) else value
    return cls(**built)
