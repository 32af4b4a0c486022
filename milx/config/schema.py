"""Every hyperparameter, as plain dataclasses.

`milx.config.presets.make_config` fills them; a launcher's `--config.path.to.field=value` overrides one field.
"""

import dataclasses
import functools
import json
import pathlib
import typing
from typing import Any

from milx.config.check import check_config

GIVEN = ("video+state+action", "video+state", "video")
"""What a demonstration can show of a new task."""

VARIANTS = ("maml", "anil", "boil", "cavia", "multi_step")
"""Relatives of MAML (Finn et al. 2017): the inner step changes the last layer only (ANIL, Raghu et al. 2020), all but
the last (BOIL, Oh et al. 2021) or the bias transformation only (CAVIA, Zintgraf et al. 2019); or the loss after every
inner step counts (MAML++, Antoniou et al. 2019)."""


@dataclasses.dataclass
class EnvConfig:
    """The world.

    Attributes:
        image_shape: (H, W) of the policy's image in pixels.
        action_cost: weight of the actions among the residuals whose squares the planner sums: with a lower one the
            expert moves at once and fast, and its first actions tell where it goes; None for the environment's own.
    """

    image_shape: tuple[int, int] = (64, 80)
    action_cost: float | None = None


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
            a file with VGG-19's first layer (`milx.networks.fixed_filters`); None for one that is learned.
        mixed_precision: convolve in bfloat16; parameters, norms and all other layers stay in float32.
        rematerialise: keep only the inputs of each convolution for the backward pass and compute the rest a second
            time: less memory, more time, the same results.
        soft_argmax: spatial soft-argmax after the last convolution, with a learned temperature; flattened otherwise.
        fc_layers: sizes of the hidden fully connected layers.
        fc_norm: layer norm in the hidden fully connected layers.
        fc_init_std: standard deviation of their first weights; None for LeCun's initialisation.
        bias_transformation: size of the learned vector beside the first fully connected layer's input; 0 for none.
        heads: 1, or 2 for a separate output layer in the inner loss.
        inner_first_layer: a first fully connected layer of its own in the inner loss, as in the released code where
            demonstrations are video alone.
        goal_head: predict where the episode ends, from the image, or from the state where the policy sees no pixels,
            and show the prediction to the layers after it (`milx.networks.goal`).
        calibrate: start the goal head's votes from the camera's calibration, where it is known.
        target_head: predict where the episode ends with a linear layer from the first image's features, and show the
            prediction to the layers after it, as the paper does (Section 6.3); its squared error joins all losses.
        hindsight_head: where a demonstration is video alone, learn to tell from its first and last image what the goal
            head is to see in the first, and let that be the goal in the inner step.
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
    inner_first_layer: bool = False
    goal_head: bool = False
    calibrate: bool = True
    target_head: bool = False
    hindsight_head: bool = False
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
        variant: one of VARIANTS: what the inner step changes, or which of its results the meta-objective sees.
        loss_scale: m; errors of the actions are multiplied by it before they are squared.
        whiten_actions: let the network predict actions with zero mean and unit variance.
        goal_weight: weight of the goal head's negative log likelihoods, or of the target head's squared error.
        given: what a policy is shown of a new task: one of GIVEN. Queries, in meta-training, show everything.
    """

    inner_steps: int = 1
    inner_lr: float = 1e-3
    learn_inner_lr: bool = False
    inner_clip: float = 20.0
    first_order: bool = False
    variant: str = "maml"
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
        imitation_steps: so many of them, the first, imitate all demonstrations without an inner step (MIL only).
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
    imitation_steps: int = 0
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


def to_dict(config: Config) -> dict[str, Any]:
    """The configuration as nested dictionaries that JSON can hold."""
    return dataclasses.asdict(config)


def from_dict(values: dict[str, Any]) -> Config:
    """The inverse of `to_dict`, also after a trip through JSON.

    Raises:
        ValueError: for a field that does not exist (the message lists those that do), or has a value that it cannot.
    """
    config = _build(Config, values, "config")
    check_config(config)
    return config


def read(path: pathlib.Path) -> Config:
    """The configuration in a JSON file.

    Raises:
        ValueError: if it holds none; the message names the file.
    """
    try:
        return from_dict(json.loads(path.read_text()))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected a configuration: {error}") from error


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


def _build(cls: type, values: dict[str, Any], path: str) -> Any:
    types = typing.get_type_hints(cls)
    if not isinstance(values, dict) or not all(isinstance(name, str) for name in values):
        raise ValueError(f"{path}: got {values!r}, expected a group of fields")
    unknown = sorted(set(values) - set(types))
    if unknown:
        raise ValueError(f"{path}: no such field {unknown[0]!r}, expected one of {', '.join(types)}")
    built = {}
    for name, value in values.items():
        if dataclasses.is_dataclass(types[name]):
            value = _build(typing.cast(type, types[name]), value, f"{path}.{name}")
        built[name] = tuple(value) if isinstance(value, list) else value
    return cls(**built)
