"""A simulated world and what is seen of it: pure functions of a task and a state, batched by `jax.vmap`.

A *task* says what is to be done and how the world looks (colors, shapes, masses); every demonstration and trial of a
task starts in another *scene* (positions), which lives in the state. Both are pytrees of arrays.
"""

import abc
import copy
import dataclasses
import functools
import pathlib
from typing import Any, Generic, Self, TypeVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from milx.core import platform
from milx.core.mjx import mjx
from milx.envs.kinematics import kinematics
from milx.envs.warp import WarpPhysics
from milx.render.scene import Renderer
from milx.render.textures import Textures
from milx.types import Observation

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


class World(abc.ABC, Generic[TaskT]):
    """Dynamics and observation on MJX, for tasks of type `TaskT`, a pytree of arrays.

    Attributes:
        substeps: physics steps in one action.
        image_shape: (H, W) of the published experiment.
        camera: the MJCF camera that the policy sees through.
        vision: whether the policy sees the image; if not, the state tells it where the objects are.

    Args:
        model: MuJoCo's model.
        image_shape: (H, W) in pixels; the class attribute if None.
    """

    substeps: int
    image_shape: tuple[int, int]
    camera: str
    vision: bool = True

    def __init__(self, model: mujoco.MjModel, image_shape: tuple[int, int] | None = None):
        platform.warn_if_not_configured()
        self.mj_model = model
        device = jax.local_devices()[0]  # MJX would take the first of all, which may be another host's
        self.model = mjx.put_model(model, device, impl="jax")
        if image_shape is not None:
            self.image_shape = image_shape
        self.renderer = Renderer(model, self.camera, *self.image_shape)
        self._data = mjx.make_data(self.model, device)
        self._warp: WarpPhysics | None = None
        self._by_jax: Any = None

    @property
    def differentiable(self) -> Self:
        """The world whose steps can be differentiated: this one, or that of which `by_warp` made it."""
        return self if self._by_jax is None else self._by_jax

    @property
    def physics(self) -> str:
        """Whose implementation of MJX steps the world, one of `milx.config.schema.PHYSICS`."""
        return "warp" if self._warp else "jax"

    @property
    def captures_graphs(self) -> bool:
        """Whether CUDA graphs are captured from JAX's stream while the world is stepped, as Warp does on a GPU.

        Nothing may compile in another thread meanwhile: XLA's autotuning probably uses the stream, too, and then the
        capture fails.
        """
        return self.physics == "warp" and jax.default_backend() == "gpu"

    def by_warp(self) -> Self:
        """Returns a copy that is stepped by MuJoCo Warp.

        Raises:
            ValueError: for a world that overrides `integrate`; where `warp-lang` is not installed; on a device that is
                neither an NVIDIA GPU nor a CPU.
        """
        if type(self).integrate is not World.integrate:
            raise ValueError(
                f"env.physics: got 'warp', expected 'jax' for {type(self).__name__}, whose steps are its own"
            )
        world = copy.copy(self)
        # Of some pairs of geoms Warp finds up to twice as many contacts, for example of two boxes.
        contacts, constraints = 2 * self._data._impl.ncon, 2 * self._data._impl.nefc
        world._warp, world._by_jax = WarpPhysics(self.mj_model, contacts, constraints), self
        return world

    @property
    def action_size(self) -> int:
        """A, the number of actuators."""
        return self.mj_model.nu

    @property
    def action_range(self) -> tuple[jax.Array, jax.Array]:
        """The lowest and highest action, [A] each; `step` clips to it.

        Raises:
            ValueError: for an actuator without a range.
        """
        if not (limited := self.mj_model.actuator_ctrllimited.astype(bool)).all():
            named = self._named(int(np.argmin(limited)))
            raise ValueError(f"ctrlrange: got none for {named}, expected the lowest and highest action")
        low, high = self.mj_model.actuator_ctrlrange.T
        return jnp.asarray(low, float), jnp.asarray(high, float)

    @property
    def state_size(self) -> int:
        """S, the size of `observe(...).state`."""
        position = jnp.asarray(self.mj_model.qpos0, float)
        state = State(position, jnp.zeros(self.mj_model.nv), jnp.zeros((self.mj_model.nmocap, 3)))
        return int(jax.eval_shape(self.robot_state, state).shape[0])

    @abc.abstractmethod
    def reset(self, key: jax.Array, task: TaskT) -> State:
        """Draws a scene of the task: the state at the start of an episode."""

    def robot_state(self, state: State) -> jax.Array:
        """Returns [S], what the robot knows of itself and, without an image, of the objects (units in the subclass).

        The positions (rad, m) and then the velocities (rad/s, m/s) of the joints that have actuators, in the model's
        order, unless overridden.

        Raises:
            ValueError: for an actuator that is not on a hinge or a slide, unless overridden.
        """
        model, moved = self.mj_model, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        for actuator, joint in enumerate(model.actuator_trnid[:, 0]):
            on_joint = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
            if not on_joint or mujoco.mjtJoint(model.jnt_type[joint]) not in moved:
                expected = "a hinge or a slide, or a `robot_state` of the environment's own"
                raise ValueError(f"{self._named(actuator)}: got no joint that a robot knows, expected {expected}")
        joints = np.unique(model.actuator_trnid[:, 0])
        return jnp.concatenate([state.qpos[model.jnt_qposadr[joints]], state.qvel[model.jnt_dofadr[joints]]])

    def _named(self, actuator: int) -> str:
        return f"actuator {actuator} ({self.mj_model.actuator(actuator).name or 'without a name'})"

    def colors(self, task: TaskT) -> jax.Array:
        """Returns [G, 4] RGBA in [0, 1] of every geom in this task; those of the model unless overridden."""
        return jnp.asarray(self.mj_model.geom_rgba, float)

    def textures(self, task: TaskT, data: mjx.Data) -> Textures | None:
        """Returns the textures [G] of all geoms, with frames that take the world's; none unless overridden."""
        return None

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
        if self._warp:
            return state.with_vector(self._warp.advance(model, state.vector, state.mocap_pos, ctrl, substeps))
        x, _ = jax.lax.scan(
            lambda x, _: (self.integrate(model, state.with_vector(x), ctrl), None), state.vector, length=substeps
        )
        return state.with_vector(x)

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
        """Draws images [F, H, W, 3] uint8 of an episode and its outcome; `states` has a leading axis T + 1.

        It is compiled for pixels (`platform.pixel_options`), so it must not step a model with a long chain.
        """
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
