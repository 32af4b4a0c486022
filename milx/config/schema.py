"""Every hyperparameter, as plain dataclasses; fields say the least and the greatest number that they may hold.

Two groups depend on the method: `Config.network` and `Config.method` are the classes that it was registered with
(`milx.config.registry`), which extend `NetworkConfig` and `MethodConfig`. A launcher's `--config.path.to.field=value`
overrides one field.
"""

import dataclasses
import math
from typing import Any

GIVEN = ("video+state+action", "video+state", "video")
"""What a demonstration can show of a new task."""
LARGEST_SIZE = 1 << 14
"""Of a layer, or of a side of an image: more is a slip of the finger."""


def number(default: Any, low: float = 1, high: float = math.inf) -> Any:
    """A field of numbers, or of a tuple of them, that lie between `low` and `high`; other fields are counts, from 1."""
    return dataclasses.field(default=default, metadata={"low": low, "high": high})


@dataclasses.dataclass
class EnvConfig:
    """The world.

    Attributes:
        image_shape: (H, W) of the policy's image in pixels.
        action_cost: weight of the actions among the residuals whose squares the planner sums: with a lower one the
            expert moves at once and fast, and its first actions tell where it goes; None for the environment's own.
    """

    image_shape: tuple[int, int] = number((64, 80), 1, 4096)
    action_cost: float | None = number(None, 0)


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
    noise: float = number(0.01, 0)
    spare_demos: int = number(0, 0, 1000)
    plan_iterations: int = number(16, 0, 10_000)
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
    horizon: int = number(50, 1, 100_000)
    goal_indices: tuple[int, ...] = number((), 0, 100_000)
    gib: float = number(2.0, 0, 100_000)


@dataclasses.dataclass
class NetworkConfig:
    """The networks of all methods: convolutions, then fully connected layers that also see the robot's state.

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
        goal_head: predict where the episode ends, from the image, or from the state where the policy sees no pixels,
            and show the prediction to the layers after it (`milx.networks.goal`).
        calibrate: start the goal head's votes from the camera's calibration, where it is known.
    """

    filters: tuple[int, ...] = number((40, 40, 40), 1, LARGEST_SIZE)
    strides: tuple[int, ...] = number((2, 2, 2), 1, 64)
    kernel: int = number(3, 1, 64)
    fixed_filters: str | None = None
    mixed_precision: bool = False
    rematerialise: bool = False
    soft_argmax: bool = False
    fc_layers: tuple[int, ...] = number((200, 200, 200, 200), 1, LARGEST_SIZE)
    fc_norm: bool = True
    fc_init_std: float | None = number(None, 0)
    goal_head: bool = False
    calibrate: bool = True


@dataclasses.dataclass
class MethodConfig:
    """What holds for all methods.

    Attributes:
        loss_scale: m; errors of the actions are multiplied by it before they are squared.
        whiten_actions: let the network predict actions with zero mean and unit variance.
        goal_weight: weight of the goal head's negative log likelihoods, or of the target head's squared error.
        given: what a policy is shown of a new task: one of GIVEN. Queries, in meta-training, show everything.
    """

    loss_scale: float = number(1.0, 0)
    whiten_actions: bool = False
    goal_weight: float = number(0.0, 0)
    given: str = GIVEN[0]


@dataclasses.dataclass
class OptimizerConfig:
    """Adam on the meta-objective.

    Attributes:
        learning_rate: its peak.
        warmup: fraction of the run that warms up linearly from zero.
        cosine: decay to zero along a cosine over the run; constant otherwise.
        clip_norm: bound on the global norm of the meta-gradient; None for none.
    """

    learning_rate: float = number(1e-3, 0)
    warmup: float = number(0.0, 0, 1)
    cosine: bool = False
    clip_norm: float | None = number(None, 0)


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
    """A whole run; `milx.config.assemble` puts it together."""

    env_name: str
    method_name: str
    preset: str
    seed: int = number(0, 0, 2**32 - 1)
    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    data: DataConfig = dataclasses.field(default_factory=DataConfig)
    recorded: RecordedConfig = dataclasses.field(default_factory=RecordedConfig)
    network: NetworkConfig = dataclasses.field(default_factory=NetworkConfig)
    method: MethodConfig = dataclasses.field(default_factory=MethodConfig)
    optimizer: OptimizerConfig = dataclasses.field(default_factory=OptimizerConfig)
    train: TrainConfig = dataclasses.field(default_factory=TrainConfig)
    evaluation: EvalConfig = dataclasses.field(default_factory=EvalConfig)
