"""The environment interface: pure functions of a task and a state, batched by `jax.vmap`.

A *task* says what is to be done and how the world looks (colors, shapes, masses); every demonstration and trial of a
task starts in another *scene* (positions), which lives in the state. Both are pytrees of arrays.
"""

import abc
import dataclasses
import functools
import pathlib
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from milx.core import platform
from milx.core.mjx import mjx
from milx.envs.kinematics import kinematics
from milx.envs.steering import Steering
from milx.render.scene import Renderer
from milx.render.textures import Textures
from milx.types import SPLITS, Observation, Spec

Task = Any
"""A pytree of arrays: what an environment means by a task."""

TaskT = TypeVar("TaskT")
OUT_OF_THE_WAY = (0.0, 0.0, -10.0)
"""Where geoms are put that a task does not use (m)."""
ASSETS = pathlib.Path(__file__).parent / "assets"


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """The physical state of one world (any leading axes may stand in front).

    Attributes:
        qpos: [nq] joint positions (rad, m).
        qvel: [nv] joint velocities (rad/s, m/s).
        mocap_pos: [O, 3] positions of the bodies that stand where the scene puts them (m).
    """

    qpos: jax.Array
    qvel: jax.Array
    mocap_pos: jax.Array

    @property
    def vector(self) -> jax.Array:
        """[nq + nv]: the part of the state that the dynamics change, as trajectory optimization sees it."""
        return jnp.concatenate([self.qpos, self.qvel], axis=-1)

    def with_vector(self, x: jax.Array) -> "State":
        """Returns the same scene with `qpos` and `qvel` taken from `x` [nq + nv]."""
        nq = self.qpos.shape[-1]
        return dataclasses.replace(self, qpos=x[..., :nq], qvel=x[..., nq:])


class Env(abc.ABC, Generic[TaskT]):
    """A simulated environment on MJX, for tasks of type `TaskT`, a pytree of arrays.

    Subclasses set the class attributes and write the abstract methods. All methods are pure and take one world;
    `jax.vmap` gives batches.

    Attributes:
        name: the registry's key.
        horizon: T, actions in an episode.
        substeps: physics steps in one action.
        image_shape: (H, W) of the published experiment.
        camera: the MJCF camera that the policy sees through.
        criterion: what counts as success, in words, for result files.
        goal_indices: entries of the robot's state that tell where it is heading (`milx.data.goals`).
        height_index: the entry that tells how high its hand is, where it must come down to an object; None otherwise.
        vision: whether the policy sees the image; if not, the state tells it where the objects are.
        object_indices: for each of the O objects, the two entries of the state that hold its position, where the state
            tells it.
        tactics: ways in which the controller may go about a scene, in the order of preference; what the numbers mean is
            the controller's affair.
        long_chain: whether a step computes MJX's kinematics of more than three joints in a chain, which old CPU
            compilers must not fuse (`platform.pixel_options`).
        action_cost: weight of the action in the planner's running cost (no unit): the lower, the faster the expert.
        version: raised when tasks, scenes, physics, costs or the controller change, so that no demonstration planned
            before it is taken for one planned after it.
    """

    name: str
    horizon: int
    substeps: int
    image_shape: tuple[int, int]
    camera: str
    criterion: str
    goal_indices: tuple[int, ...]
    height_index: int | None = None
    vision: bool = True
    object_indices: tuple[tuple[int, ...], ...] = ()
    tactics: tuple[float, ...] = (0.0,)
    long_chain: bool = True
    action_cost: float = 1.0
    version: int = 1

    def __init__(self, model: mujoco.MjModel, image_shape: tuple[int, int] | None = None):
        platform.warn_if_not_configured()
        self.mj_model = model
        device = jax.local_devices()[0]  # MJX would take the first of all, which may be another host's
        self.model = mjx.put_model(model, device)
        if image_shape is not None:
            self.image_shape = image_shape
        self.renderer = Renderer(model, self.camera, *self.image_shape)
        self._data = mjx.make_data(self.model, device)

    @property
    def action_size(self) -> int:
        """A, the number of actuators."""
        return self.mj_model.nu

    @property
    def action_range(self) -> tuple[jax.Array, jax.Array]:
        """The lowest and highest action, [A] each; `step` clips to it."""
        low, high = self.mj_model.actuator_ctrlrange.T
        return jnp.asarray(low, float), jnp.asarray(high, float)

    @property
    def spec(self) -> Spec:
        """The sizes of what a policy sees and does."""
        low, high = (tuple(np.asarray(limit).tolist()) for limit in self.action_range)
        calibration = self.image_to_goal
        image_to_goal = None if calibration is None else tuple(tuple(row) for row in calibration.tolist())
        image_shape = self.image_shape if self.vision else None
        sizes = image_shape, self.state_size, self.action_size
        return Spec(*sizes, (low, high), self.goal_indices, image_to_goal, self.object_indices, self.height_index)

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

    @property
    @abc.abstractmethod
    def state_size(self) -> int:
        """S, the size of `observe(...).state`."""

    @abc.abstractmethod
    def sample_task(self, key: jax.Array, split: str) -> TaskT:
        """Draws a task of a split ("train", "validation" or "test"); raises ValueError for another split."""

    @abc.abstractmethod
    def redraw_appearance(self, key: jax.Array, task: TaskT) -> TaskT:
        """Changes the task's appearance to another of the training split; its demonstrations are valid for both."""

    @abc.abstractmethod
    def redraw_scene(self, key: jax.Array, task: TaskT, states: State) -> State:
        """Moves what did not take part in an episode to where `reset` might have put it.

        `states` has a leading axis T + 1. Where everything takes part, this is `states`.
        """

    @abc.abstractmethod
    def reset(self, key: jax.Array, task: TaskT) -> State:
        """Draws a scene of the task: the state at the start of an episode."""

    @abc.abstractmethod
    def robot_state(self, state: State) -> jax.Array:
        """Returns [S], what the robot knows of itself and, without an image, of the objects (units in the subclass)."""

    @abc.abstractmethod
    def colors(self, task: TaskT) -> jax.Array:
        """Returns [G, 4] RGBA in [0, 1] of every geom in this task."""

    def textures(self, task: TaskT, data: mjx.Data) -> Textures | None:
        """Returns the textures [G] of all geoms, with frames that take the world's; none unless overridden."""
        return None

    @abc.abstractmethod
    def running_residual(self, task: TaskT, state: State, action: jax.Array, t: jax.Array) -> jax.Array:
        """Computes the residual [R] of the running cost at step t; the expert minimizes half its square."""

    @abc.abstractmethod
    def terminal_residual(self, task: TaskT, state: State) -> jax.Array:
        """Computes the residual [R'] of the terminal cost."""

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

    def control(self, task: TaskT, state: State, tactic: jax.Array) -> jax.Array:
        """Returns the action [A] of a controller that knows the task, by one of the `tactics`. It may replace iLQR.

        Raises:
            ValueError: unless overridden.
        """
        raise ValueError(f"data.plan_iterations: got 0, expected at least 1: {self.name} has no controller")

    @property
    def steering(self) -> Steering:
        """What the planner by sampling chooses: the actions, which do not return to a path, unless overridden."""
        low, high = self.action_range
        controls = lambda state, u: u  # noqa: E731
        return Steering(low, high, 0.15 * (high - low), controls, lambda state, expected: jnp.zeros_like(low))

    def guess(self, task: TaskT, state: State) -> jax.Array:
        """Returns actions [T, A] with which the planner begins; zero unless overridden."""
        return jnp.zeros((self.horizon, self.action_size))

    def model_of(self, task: TaskT) -> mjx.Model:
        """Returns the model with the task's shapes, masses and friction; the same for all tasks unless overridden."""
        del task
        return self.model

    def data(self, state: State) -> mjx.Data:
        """Makes MJX data that hold this state; derived quantities are not computed yet."""
        return self._data.replace(qpos=state.qpos, qvel=state.qvel, mocap_pos=state.mocap_pos)

    @functools.partial(jax.jit, static_argnums=0)  # so that MJX, slow to trace, is traced once for all callers
    def step(self, task: TaskT, state: State, action: jax.Array) -> State:
        """Applies `action` [A], clipped to `action_range`, for `substeps` physics steps."""
        return self._advance(self.model_of(task), state, action, self.substeps)

    def _advance(self, model: mjx.Model, state: State, action: jax.Array, substeps: int) -> State:
        """Applies `action` [A], clipped to `action_range`, for some physics steps of the model."""
        ctrl = jnp.clip(action, *self.action_range)

        # Only positions and velocities are carried: MJX's data is large, and the rest follows from them.
        x, _ = jax.lax.scan(
            lambda x, _: (self.integrate(model, state.with_vector(x), ctrl), None), state.vector, length=substeps
        )
        return state.with_vector(x)

    def approximate_step(self, task: TaskT, state: State, action: jax.Array) -> State:
        """Approximates `step` for planners: iLQR differentiates it, and sampling rolls candidates out by it.

        The same as `step` unless overridden.
        """
        return self.step(task, state, action)

    def integrate(self, model: mjx.Model, state: State, ctrl: jax.Array) -> jax.Array:
        """Takes one physics step, of the model's time step, and returns the next `state.vector`."""
        data = mjx.step(model, self.data(state).replace(ctrl=ctrl))
        return jnp.concatenate([data.qpos, data.qvel])

    @functools.partial(jax.jit, static_argnums=0)
    def observe(self, task: TaskT, state: State) -> Observation:
        """Shows what the policy sees: the image [H, W, 3] uint8 (None without vision) and the state [S]."""
        image = self.render(task, state) if self.vision else None
        return Observation(image=image, state=self.robot_state(state))

    @functools.partial(jax.jit, static_argnums=0)
    def render(self, task: TaskT, state: State) -> jax.Array:
        """Draws the camera's image [H, W, 3] uint8 of the task's scene."""
        return self._draw(self.model_of(task), task, state)

    def film(self, task: TaskT, states: State) -> jax.Array:
        """Draws images [F, H, W, 3] uint8 of an episode and its outcome; `states` has a leading axis T + 1."""
        return jax.vmap(self.render, in_axes=(None, 0))(task, states)

    def _draw(self, model: mjx.Model, task: TaskT, state: State) -> jax.Array:
        """Draws the image of a state in this model."""
        data = kinematics(model, self.data(state))
        data = mjx.camlight(model, mjx.com_pos(model, data))
        scene = dataclasses.replace(
            self.renderer.scene(data),
            geom_size=model.geom_size,
            geom_rgba=self.colors(task),
            texture=self.textures(task, data),
        )
        return self.renderer.pixels(scene)


def check_split(split: str) -> None:
    """Raises ValueError unless `split` is one of SPLITS."""
    if split not in SPLITS:
        raise ValueError(f"split: got {split!r}, expected one of {', '.join(SPLITS)}")
