"""All hyperparameters, as plain dataclasses. Each field defines the minimum and the maximum of its numbers.

Two groups depend on the method: `Config.network` and `Config.method` are instances of the classes that the method was
registered with (`milx.config.registry`). These classes extend `NetworkConfig`, or `VisionConfig` where the networks see
images, and `MethodConfig`. The launchers' flag `--config.path.to.field=value` overrides one field.
"""

import dataclasses
import math
from typing import Any

GIVEN = ("video+state+action", "video+state", "video")
"""The parts of a demonstration of a new task that a policy may be shown."""
PHYSICS = ("jax", "warp")
"""Who steps the worlds: MJX's implementation in JAX, or MuJoCo Warp (`milx.envs.warp`)."""
LARGEST_SIZE = 1 << 14
"""Maximum size of a layer. A larger value is most likely a typing error."""


def number(default: Any, low: float = 1, high: float = math.inf) -> Any:
    """Defines a field whose number, or tuple of numbers, must be at least `low` and at most `high`.

    The numbers of all other fields must be at least 1.
    """
    return dataclasses.field(default=default, metadata={"low": low, "high": high})


@dataclasses.dataclass
class EnvConfig:
    """The environment.

    Attributes:
        image_shape: (H, W) of the policy's image in pixels.
        action_cost: weight of the actions among the residuals whose squares the planner sums. With a lower weight the
            expert starts at once and moves fast, so its first actions show where it goes. None for the environment's
            own weight.
        goal_step: the time step of a demonstration at which the robot is at the goal that a goal head learns to see
            (`milx.data.goals`). None for the environment's own rule: in push where the hand comes down, and elsewhere
            where the demonstration ends.
        physics: who steps the world, one of PHYSICS. Warp is made for NVIDIA's GPUs, and has been tried with one in a
            process. It has no derivatives, so that iLQR plans by MJX in JAX all the same. Reach and place can be
            stepped by MJX in JAX only.
    """

    image_shape: tuple[int, int] = number((64, 80), 1, 4096)
    action_cost: float | None = number(None, 0)
    goal_step: int | None = number(None, 1)
    physics: str = "jax"


@dataclasses.dataclass
class DataConfig:
    """Expert demonstrations.

    Attributes:
        tasks: number of training tasks.
        demos_per_task: demonstrations of each training task, in different scenes.
        noise: standard deviation of the Gaussian noise on the expert's actions, in units of the action.
        spare_demos: additional demonstrations of each validation and test task, so that failed ones can be replaced.
        expert: who demonstrates: "ilqr" plans; "sampling" plans whole episodes (`milx.trajopt.planner`), and "receding"
            the next time steps (`milx.trajopt.receding`), without derivatives; "ppo" is a network that first learns to
            minimize the same cost (`milx.trajopt.learned`), and "pretrained" such a network that ships, for push.
            `milx.data.experts.EXPERTS` has them by name.
        plan_iterations: iterations of trajectory optimization for a demonstration: with "ilqr" their maximum number;
            with "sampling" their number, 8 in the results that are reported; with "receding" their number in each of
            many plans, for which 1 is enough; with "ppo" the number of batches of episodes that the network learns from
            before it demonstrates; with the others nothing.
        plan_batch: demonstrations planned at once; with "sampling" each of them rolls out 64 plans at once, with
            "receding" 96.
    """

    tasks: int = 1500
    demos_per_task: int = 10
    noise: float = number(0.01, 0)
    spare_demos: int = number(0, 0, 1000)
    expert: str = "ilqr"
    plan_iterations: int = number(16, 0, 10_000)
    plan_batch: int = 4096


@dataclasses.dataclass
class RecordedConfig:
    """Recorded demonstrations, which replace an environment (`milx.data.dataset`).

    Attributes:
        path: the data set's folder.
        horizon: number of time steps that every demonstration is resampled to.
        goal_indices: indices of the entries of the state that hold the robot's position. A goal head predicts their
            values at the end of the demonstration.
        gib: device memory, in GiB, for the demonstrations from which one scan of meta-updates samples its batches.
            While a scan runs, the next scan's demonstrations are loaded, which can take as much memory again.
        history: number of observations that the policy sees at every time step: the latest one and those of the
            recording's time steps before it; the first of an episode stands for those before it
            (`milx.methods.history`). Images take so many times the memory.
        crop: images lose twice so many rows and columns: in training a part at a random place is left, and the middle
            when the policy adapts and acts.
        shift: maximum number of pixels by which the images of a demonstration are moved at random in training.
        recolor: maximum relative change of the brightness of each of their channels in training.
    """

    path: str = ""
    horizon: int = number(50, 1, 100_000)
    goal_indices: tuple[int, ...] = number((), 0, 100_000)
    gib: float = number(2.0, 0, 100_000)
    history: int = number(1, 1, 100)
    crop: int = number(0, 0, 1000)
    shift: int = number(0, 0, 1000)
    recolor: float = number(0.0, 0, 1)


@dataclasses.dataclass
class NetworkConfig:
    """The fully connected layers that the networks of all methods have.

    Attributes:
        fc_layers: sizes of the hidden fully connected layers.
        fc_norm: apply layer norm in the hidden fully connected layers.
        fc_init_std: standard deviation of the initial weights of these layers; None for LeCun's initialization.
    """

    fc_layers: tuple[int, ...] = number((200, 200, 200, 200), 1, LARGEST_SIZE)
    fc_norm: bool = True
    fc_init_std: float | None = number(None, 0)


@dataclasses.dataclass
class ConvConfig:
    """The convolutions of networks that see images.

    Attributes:
        filters: output channels of each convolution.
        strides: stride of each convolution.
        kernel: height and width of every kernel.
        residual_blocks: number of residual blocks after each convolution; each adds two more convolutions, with
            stride 1, to what comes in (He et al. 2016).
        fixed_filters: source of a first convolution that is never trained: "kmeans" for clusters of patches of the
            training images, or a file with VGG-19's first layer (`milx.networks.fixed_filters`). None for a learned
            first convolution.
        mixed_precision: compute convolutions in bfloat16; parameters, norms and all other layers stay in float32.
        rematerialise: keep only the input of each convolution for the backward pass and compute the rest a second time.
            This takes less memory and more time; the results are the same.
        soft_argmax: apply a spatial soft-argmax with a learned temperature after the last convolution; otherwise its
            output is flattened.
    """

    filters: tuple[int, ...] = number((40, 40, 40), 1, LARGEST_SIZE)
    strides: tuple[int, ...] = number((2, 2, 2), 1, 64)
    kernel: int = number(3, 1, 64)
    residual_blocks: int = number(0, 0, 64)
    fixed_filters: str | None = None
    mixed_precision: bool = False
    rematerialise: bool = False
    soft_argmax: bool = False


@dataclasses.dataclass
class VisionConfig(NetworkConfig, ConvConfig):  # in this order of the bases, fields of convolutions come first
    """Convolutions, then fully connected layers that also receive the robot's state, and a goal head.

    Attributes:
        goal_head: predict the goal from the image, or from the state if the policy sees no pixels, and pass the
            prediction on to the following layers (`milx.networks.goal`).
        calibrate: initialize the goal head's votes from the camera's calibration, if it is known.
        share_encoder: with several cameras, apply the same convolutions to the images of all; otherwise each camera has
            its own.
    """

    goal_head: bool = False
    calibrate: bool = True
    share_encoder: bool = False


@dataclasses.dataclass
class MethodConfig:
    """The settings that all methods have.

    Attributes:
        loss_scale: factor by which the errors of the actions are multiplied before they are squared.
        whiten_actions: let the network predict actions that are whitened to zero mean and unit variance.
        goal_weight: weight of the goal head's negative log likelihoods, or of the target head's squared error.
        chunk: number of time steps whose actions the policy predicts at once.
        execute: number of actions that are executed of a chunk before the next chunk counts; 0 for the mean of what all
            chunks say of a time step (`milx.methods.chunks`).
        given: the parts of a demonstration of a new task that the policy is shown, one of GIVEN. In meta-training,
            query demonstrations always have all parts.
    """

    loss_scale: float = number(1.0, 0)
    whiten_actions: bool = False
    goal_weight: float = number(0.0, 0)
    chunk: int = number(1, 1, 1000)
    execute: int = number(1, 0, 1000)
    given: str = GIVEN[0]


OPTIMIZERS = ("adam", "muon")


@dataclasses.dataclass
class OptimizerConfig:
    """The optimizer of the meta-objective.

    Attributes:
        name: one of OPTIMIZERS. "adam" (Kingma and Ba 2015) is the published one. "muon" (Jordan et al. 2024) replaces
            the moving average of a kernel's gradient by an orthogonal matrix near it, of root mean square 0.4; the
            other parameters have Adam with Nesterov's momentum (Dozat 2016).
        learning_rate: the maximum learning rate.
        warmup: fraction of the meta-updates in which the learning rate rises linearly from zero.
        cosine: let the learning rate decay to zero along a cosine over the rest of the run; otherwise it is constant.
        clip_norm: bound on the global norm of the meta-gradient; None for no bound.
    """

    name: str = OPTIMIZERS[0]
    learning_rate: float = number(1e-3, 0)
    warmup: float = number(0.0, 0, 1)
    cosine: bool = False
    clip_norm: float | None = number(None, 0)


@dataclasses.dataclass
class TrainConfig:
    """The meta-training loop.

    Attributes:
        init: where parameters come from: a run's folder, or the name of a policy that ships with milx, as far as names
            and sizes are the same; or a .safetensors or .npz file (`milx.training.start`). None to draw all of them.
        steps: number of meta-updates.
        meta_batch: tasks in a meta-batch.
        shots: support demonstrations of each task.
        support_frames: time steps sampled from each support demonstration; None for all.
        query_frames: time steps sampled from each query demonstration; None for all.
        frame_exponent: 1 samples time steps evenly, a larger exponent samples more of the beginning of a
            demonstration, where the policy cannot yet see from the robot's own pose where it is going.
        redraw: whenever a task is sampled, give it a new appearance of the training split, and give the distractors in
            its demonstrations new positions; show half of the tasks in a mirror, where the environment has one
            (`Env.mirror`). A few planned demonstrations then stand for many tasks and scenes.
        log_every: meta-updates in one scan on the device; metrics are logged after every scan.
        eval_every: meta-updates between two validations, each with a checkpoint.
        wandb: a project in Weights & Biases that metrics are sent to, too (`milx.training.tracking`); None for none.
    """

    init: str | None = None
    steps: int = 30_000
    meta_batch: int = 5
    shots: int = 1
    support_frames: int | None = None
    query_frames: int | None = None
    frame_exponent: float = number(1.0, 1, 10)
    redraw: bool = False
    log_every: int = 100
    eval_every: int = 2000
    wandb: str | None = None


@dataclasses.dataclass
class EvalConfig:
    """Closed-loop evaluation.

    Runs on recorded demonstrations have it only if `gym` is set; they read that, `gym_python`, `gym_workers`, `trials`
    and `shots` alone.

    Attributes:
        validation_tasks: held-out tasks for selecting the best checkpoint.
        tasks: held-out tasks for the reported result (test tasks).
        trials: scenes in which each task is tried.
        baseline_trials: number of these scenes in which the experts, random actions, and the policy with another task's
            demonstration are tried, too.
        shots: demonstrations that the policy adapts to.
        batch: tasks rolled out at once.
        gym: "module:function", which makes the world (`milx.worlds`) in which checkpoints are validated; None for the
            errors of the actions.
        gym_python: the interpreter that runs it; None for this one.
        gym_workers: worlds at once.
        gym_timeout: seconds that a world may take to answer.
    """

    validation_tasks: int = 100
    tasks: int = 150
    trials: int = 10
    baseline_trials: int = 10
    shots: int = 1
    batch: int = 150
    gym: str | None = None
    gym_python: str | None = None
    gym_workers: int = 4
    gym_timeout: float = 60.0


@dataclasses.dataclass
class Config:
    """The configuration of a run, built by `milx.config.assemble`."""

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
