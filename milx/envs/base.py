"""The environment interface: what planners, benchmarks and policies ask of a world (`milx.envs.world`).

They ask by pure functions of a task and a state, which `jax.vmap` batches. An environment needs six class attributes
(`name`, `criterion`, `horizon`, `substeps`, `image_shape`, `camera`) and five methods: `sample_task` and `reset`, the
planner's `running_residual`, and the benchmark's `success` and `task_blind`. All else has a default.
"""

import abc

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from milx.envs.steering import Steering
from milx.envs.world import ASSETS, OUT_OF_THE_WAY, State, Task, TaskT, World
from milx.types import SPLITS, Spec

__all__ = ["ASSETS", "OUT_OF_THE_WAY", "Env", "State", "Task", "check_split"]


class Env(World[TaskT]):
    """A world in which tasks are drawn, planned and judged.

    Subclasses set the class attributes and write the abstract methods. All methods are pure and take one world;
    `jax.vmap` gives batches.

    Attributes:
        name: the registry's key.
        horizon: T, actions in an episode.
        criterion: what counts as success, in words, for result files.
        goal_indices: entries of the robot's state that tell where it is heading (`milx.data.goals`).
        height_index: the entry that tells how high its hand is, where it must come down to an object; None otherwise.
        goal_step: the time step of a demonstration at which the robot is at its goal; None where its height tells, or
            where the goal is the end. A configuration may override it (`env.goal_step`).
        object_indices: for each of the O objects, the two entries of the state that hold its position, where the state
            tells it.
        long_chain: whether a step computes MJX's kinematics of more than three joints in a chain, which old CPU
            compilers must not fuse (`platform.pixel_options`).
        ahead: time steps that an expert with a receding horizon looks ahead (`milx.trajopt.receding`), at least 1; the
            whole episode where that is shorter.
        mirror: the signs of the entries of the robot's state [S] and of the action [A] in a mirror that swaps the left
            and the right of the image. Robot, camera, lights, what stands still, the distribution of scenes and
            `image_to_goal` must be symmetric; what tasks draw need not be, so that a thing's mirror image may have a
            shape that no task has. None where there is no such mirror.
        action_cost: weight of the action in the planner's running cost (no unit): the lower, the faster the expert.
        version: raised when tasks, scenes, physics, costs, the steering, or what an expert that learns is told or
            supposes change, so that no demonstration made before it is taken for one made after it.
    """

    name: str
    horizon: int
    criterion: str
    goal_indices: tuple[int, ...] = ()
    height_index: int | None = None
    goal_step: int | None = None
    object_indices: tuple[tuple[int, ...], ...] = ()
    long_chain: bool = True
    ahead: int = 15
    mirror: tuple[tuple[int, ...], tuple[int, ...]] | None = None
    action_cost: float = 1.0
    version: int = 1

    # What tasks there are.

    @abc.abstractmethod
    def sample_task(self, key: jax.Array, split: str) -> TaskT:
        """Draws a task of a split ("train", "validation" or "test"); raises ValueError for another split."""

    def redraw_appearance(self, key: jax.Array, task: TaskT) -> TaskT:
        """Changes the task's appearance to another of the training split; its demonstrations are valid for both.

        The same task unless overridden.
        """
        return task

    def redraw_scene(self, key: jax.Array, task: TaskT, states: State) -> State:
        """Moves what did not take part in an episode to where `reset` might have put it.

        `states` has a leading axis T + 1. The same states unless overridden, as where everything takes part.
        """
        return states

    # What planners ask.

    @abc.abstractmethod
    def running_residual(self, task: TaskT, state: State, action: jax.Array, t: jax.Array) -> jax.Array:
        """Computes the residual [R] of the running cost at step t; the expert minimizes half its square."""

    def terminal_residual(self, task: TaskT, state: State) -> jax.Array:
        """Computes the residual [R'] of the terminal cost; the running one without an action unless overridden."""
        return self.running_residual(task, state, jnp.zeros(self.action_size), jnp.int32(self.horizon))

    def guess(self, task: TaskT, state: State) -> jax.Array:
        """Returns actions [T, A] with which iLQR begins; zero unless overridden."""
        return jnp.zeros((self.horizon, self.action_size))

    @property
    def steering(self) -> Steering:
        """What the planner by sampling chooses.

        Unless overridden, the controls [A] are the actions, scaled to [-1, 1], and nothing returns the robot to its
        path.
        """
        low, high = self.action_range
        one, middle, half = jnp.ones_like(low), (low + high) / 2, (high - low) / 2
        return Steering(-one, one, 0.3 * one, lambda state, u: middle + half * u, lambda state, expected: 0 * one)

    def approximate_step(self, task: TaskT, state: State, action: jax.Array) -> State:
        """Approximates `step` for planners: iLQR differentiates it, and sampling rolls candidates out by it.

        The same as `step` unless overridden.
        """
        return self.step(task, state, action)

    def misjudge(self, key: jax.Array, state: State) -> State:
        """Moves things to where an expert that learns supposes them (`milx.trajopt.learned`).

        With the same key they are off by as much in every state. A policy is led astray by errors that are several
        times as large, of every entry of the state, so angles and quaternions should stay. The same state unless
        overridden.
        """
        return state

    def visible(self, task: TaskT, state: State) -> jax.Array:
        """Returns what else an expert that learns is told, [L]: what an image shows beside positions, such as shapes.

        Nothing unless overridden.
        """
        return jnp.zeros(0)

    # What a benchmark asks.

    @abc.abstractmethod
    def success(self, task: TaskT, states: State) -> jax.Array:
        """Tells whether an episode succeeded. `states` has a leading axis T + 1; returns a bool scalar."""

    def other_criteria(self, task: TaskT, states: State) -> dict[str, jax.Array]:
        """Judges the episode by other criteria, by name; reported beside success, none unless overridden."""
        return {}

    @abc.abstractmethod
    def task_blind(self, key: jax.Array, task: TaskT) -> TaskT:
        """Makes a random candidate the target, as someone would who saw no demonstration."""

    def target_kind(self, task: TaskT) -> jax.Array:
        """Returns a number for the kind of the task's target; -1, the default, where every task has its own."""
        return jnp.asarray(-1)

    # What a policy must know.

    @property
    def spec(self) -> Spec:
        """The sizes of what a policy sees and does."""
        low, high = (tuple(np.asarray(limit).tolist()) for limit in self.action_range)
        calibration = self.image_to_goal
        image_to_goal = None if calibration is None else tuple(tuple(row) for row in calibration.tolist())
        image_shape = self.image_shape if self.vision else None
        sizes = image_shape, self.state_size, self.action_size
        return Spec(
            *sizes,
            (low, high),
            self.goal_indices,
            image_to_goal,
            self.object_indices,
            height_index=self.height_index,
            goal_step=self.goal_step,
        )

    @property
    def image_to_goal(self) -> np.ndarray | None:
        """[3, G] from (x, y, 1), x and y in [-1, 1] across and down the image, to the goal; None if not known."""
        return None

    def image_to_plane(self, low: tuple[float, float], high: tuple[float, float], height: float) -> np.ndarray:
        """Returns [3, 2], from (x, y, 1) to the x and y (m) seen there at this height, between `low` and `high`.

        Exact for a camera that looks straight down, else the least squares over that part of the plane.
        """
        data = mujoco.MjData(self.mj_model)
        mujoco.mj_forward(self.mj_model, data)
        camera = self.mj_model.camera(self.camera).id
        place = np.stack(np.meshgrid(*np.linspace(low, high, 5).T), axis=-1).reshape(-1, 2)
        point = np.column_stack([place, np.full(len(place), height)]) - data.cam_xpos[camera]
        x, y, z = (point @ data.cam_xmat[camera].reshape(3, 3)).T
        tangent = np.tan(np.radians(self.mj_model.cam_fovy[camera]) / 2)
        aspect = self.image_shape[1] / self.image_shape[0]
        image = np.column_stack([x / aspect, -y, -z * tangent]) / (-z * tangent)[:, None]
        return np.linalg.lstsq(image, place, rcond=None)[0]


def check_split(split: str) -> None:
    """Raises ValueError unless `split` is one of SPLITS."""
    if split not in SPLITS:
        raise ValueError(f"split: got {split!r}, expected one of {', '.join(SPLITS)}")
