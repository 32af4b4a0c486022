"""Reach: a planar two-joint arm goes to one of three cubes, known by its color or its number (paper, Section 6.1)."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from milx.core.mjx import mjx
from milx.envs.base import ASSETS, Env, State, check_split
from milx.envs.layout import first_spaced
from milx.envs.steering import Steering

NUM_OBJECTS = 3
EXTENT = 0.2
"""Cubes stand within +-EXTENT of the arm's base in x and y (m)."""
SPACING = 0.15
"""Minimum distance between two cubes' centers (m)."""
TOUCH = 0.05
"""A fingertip closer than this to the target's center, seen from above, has reached it (m)."""
LAST_STEPS = 10
"""The target must be touched in one of the last steps of the episode."""
# Color grids {offset, offset + 0.1, ...}^3 of the splits: disjoint, so that test and validation colors are held out.
COLOR_OFFSETS = {"train": 0.0, "validation": 0.025, "test": 0.05}
VELOCITY_COST = 0.02
_LEVER = 0.12
"""How far the fingertip moves when a joint turns, for the planner's guess (m/rad)."""
_CANDIDATES = 64
_UNIT, _DEVIATION = 0.03, 0.3
"""Of the planner by sampling: a control of 1 in motor commands, and how far its first candidates deviate."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ReachTask:
    """Which color to go to.

    Attributes:
        object_color: [3, 3] RGB in [0, 1] of the cubes.
        target: int32, which of them is the target.
    """

    object_color: jax.Array
    target: jax.Array


class Reach(Env[ReachTask]):
    """Two joints, three cubes, 80x64 pixels from above, 50 actions of 0.05 s.

    The robot's state is 8-dimensional: two joint angles (rad), two joint velocities (rad/s), the fingertip's position
    (m) and velocity (m/s) in the plane. An action is two motor commands in [-1, 1].
    """

    name = "reach"
    horizon = 50
    substeps = 5
    image_shape = (64, 80)
    camera = "overhead"
    criterion = f"fingertip within {TOUCH} m of the target in one of the last {LAST_STEPS} of 50 steps"
    state_size = 8
    goal_indices = (4, 5)
    long_chain = False
    action_cost = 4.0
    version = 4

    def __init__(self, image_shape: tuple[int, int] | None = None):
        super().__init__(mujoco.MjModel.from_xml_path(str(ASSETS / "reach.xml")), image_shape)
        names = ["target", "distractor_0", "distractor_1"]
        self._object_geoms = np.array([self.mj_model.geom(name).id for name in names])
        self._rgba = jnp.asarray(self.mj_model.geom_rgba, float)
        self._height = float(self.mj_model.body("target").pos[2])
        arm = _arm()
        self._arm = mjx.put_model(arm, jax.local_devices()[0], impl="jax")
        self._arm_data = mjx.make_data(self._arm, jax.local_devices()[0])
        self._links = jnp.stack([arm.body("forearm").pos[:2], arm.site("fingertip").pos[:2]])

    @property
    def image_to_goal(self) -> np.ndarray:
        """The goal is the fingertip's place, at last over a cube."""
        return self.image_to_plane((-EXTENT, -EXTENT), (EXTENT, EXTENT), self._height)

    def sample_task(self, key: jax.Array, split: str) -> ReachTask:
        """Draws three different colors from the split's grid, and the target among them."""
        check_split(split)
        color_key, target_key = jax.random.split(key)
        target = jax.random.randint(target_key, (), 0, NUM_OBJECTS)
        return ReachTask(object_color=_draw_colors(color_key, split), target=target)

    def redraw_appearance(self, key: jax.Array, task: ReachTask) -> ReachTask:
        """Keeps the target among cubes of other colors of the training grid."""
        return dataclasses.replace(task, object_color=_draw_colors(key, "train"))

    def reset(self, key: jax.Array, task: ReachTask) -> State:
        """Stands the arm at zero and the cubes uniformly in the arena, at least SPACING apart."""
        position = first_spaced(_draw_positions(key), SPACING)
        height = jnp.full((NUM_OBJECTS, 1), self._height)
        return State(jnp.zeros(2), jnp.zeros(2), jnp.concatenate([position, height], axis=-1))

    def redraw_scene(self, key: jax.Array, task: ReachTask, states: State) -> State:
        """Keeps the motion and the target, and moves the two other cubes elsewhere."""
        target = states.mocap_pos[0, task.target, :2]
        position = first_spaced(_draw_positions(key).at[:, task.target].set(target), SPACING)
        return dataclasses.replace(states, mocap_pos=states.mocap_pos.at[..., :2].set(position))

    def fingertip(self, qpos: jax.Array) -> jax.Array:
        """Computes the fingertip's position in the plane, [2] (m), from the joint angles, [2] (rad)."""
        angle = jnp.cumsum(qpos)
        x, y = self._links.T
        along, across = jnp.cos(angle), jnp.sin(angle)
        return jnp.stack([x * along - y * across, x * across + y * along]).sum(axis=-1)

    def integrate(self, model: mjx.Model, state: State, ctrl: jax.Array) -> jax.Array:
        """Takes one Runge-Kutta step like `mjx.step`, with one copy of the dynamics in the program instead of two."""
        tableau = jnp.array([[0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1, 1 / 6]], ctrl.dtype)
        return self._runge_kutta(tableau, self.mj_model.opt.timestep, state.vector, ctrl)

    def approximate_step(self, task: ReachTask, state: State, action: jax.Array) -> State:
        """Takes one midpoint step instead of `substeps` Runge-Kutta steps: a tenth of the evaluations of MJX."""
        ctrl, midpoint = jnp.clip(action, *self.action_range), jnp.array([[0.0, 0.0], [0.5, 1.0]], action.dtype)
        step = self.substeps * self.mj_model.opt.timestep
        return state.with_vector(self._runge_kutta(midpoint, step, state.vector, ctrl))

    def _runge_kutta(self, tableau: jax.Array, h: float, x0: jax.Array, ctrl: jax.Array) -> jax.Array:
        """Takes an explicit step of `h` seconds. Each row of the tableau holds a stage's node and its weight."""

        def stage(carry: tuple, coefficients: jax.Array) -> tuple[tuple, None]:
            x, slope = carry
            ahead, weight = coefficients
            slope = self._slope(x0 + h * ahead * slope, ctrl)
            return (x + h * weight * slope, slope), None

        return jax.lax.scan(stage, (x0, jnp.zeros_like(x0)), tableau)[0][0]

    @functools.partial(jax.jit, static_argnums=0)  # so that its derivative is traced once, too
    def _slope(self, x: jax.Array, ctrl: jax.Array) -> jax.Array:
        """Returns the time derivative of `state.vector`, [4] (rad/s, rad/s^2)."""
        qpos, qvel = jnp.split(x, 2)
        data = mjx.forward(self._arm, self._arm_data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl))
        return jnp.concatenate([data.qvel, data.qacc])

    def robot_state(self, state: State) -> jax.Array:
        """Returns [8] joint angles, joint velocities, fingertip position, and fingertip velocity."""
        position, velocity = jax.jvp(self.fingertip, (state.qpos,), (state.qvel,))
        return jnp.concatenate([state.qpos, state.qvel, position, velocity])

    def colors(self, task: ReachTask) -> jax.Array:
        """Returns [G, 4] RGBA of every geom."""
        return self._rgba.at[self._object_geoms, :3].set(task.object_color)

    def off_target(self, task: ReachTask, state: State) -> jax.Array:
        """Returns [2], from the target to the fingertip in the plane (m)."""
        return self.fingertip(state.qpos) - state.mocap_pos[task.target, :2]

    def running_residual(self, task: ReachTask, state: State, action: jax.Array, t: jax.Array) -> jax.Array:
        """Returns [6]: from the target to the fingertip (m), joint velocities and motor commands, weighted."""
        return jnp.concatenate([self.off_target(task, state), VELOCITY_COST * state.qvel, self.action_cost * action])

    def terminal_residual(self, task: ReachTask, state: State) -> jax.Array:
        """Returns [4]: from the target to the fingertip (m) and joint velocities, weighted."""
        return jnp.concatenate([5.0 * self.off_target(task, state), VELOCITY_COST * state.qvel])

    def guess(self, task: ReachTask, state: State) -> jax.Array:
        """Turns both joints to the nearer of the two postures in which `off_target` is zero: [T, 2].

        Each joint counts as an inertia, the armature, with its damping.
        """
        low, high = self.action_range
        model = self.mj_model
        goal = self._posture(state.qpos, self.fingertip(state.qpos) - self.off_target(task, state))
        inertia, damping, gear = model.dof_armature[:2], model.dof_damping[:2], model.actuator_gear[:, 0]
        stiffness, brake = self._regulator
        h = self.substeps * model.opt.timestep

        def step(carry: tuple, _: None) -> tuple[tuple, jax.Array]:
            qpos, qvel = carry
            ctrl = jnp.clip(stiffness * (goal - qpos) - brake * qvel, low, high)
            qvel = qvel + h * (gear * ctrl - damping * qvel) / inertia
            return (qpos + h * qvel, qvel), ctrl

        return jax.lax.scan(step, (state.qpos, state.qvel), length=self.horizon)[1]

    @property
    def steering(self) -> Steering:
        """The motors' commands [2], in units of 0.03; `_regulator` returns the joints to their path."""
        low, high = self.action_range
        stiffness, brake = self._regulator

        def correction(state: State, expected: State) -> jax.Array:
            return (stiffness * (expected.qpos - state.qpos) + brake * (expected.qvel - state.qvel)) / _UNIT

        deviation = jnp.full(2, _DEVIATION)
        return Steering(low / _UNIT, high / _UNIT, deviation, lambda state, u: _UNIT * u, correction)

    @property
    def _regulator(self) -> tuple[float, np.ndarray]:
        """The gains of commands on angles (1/rad), and on velocities ([2], s/rad).

        The regulator that minimizes the integral of (l (q - q*))^2 + (a u)^2, of an inertia j that is driven by g u
        without damping, has the gains l / a and sqrt(2 j l / (a g)).
        """
        stiffness = _LEVER / self.action_cost
        inertia, gear = self.mj_model.dof_armature[:2], self.mj_model.actuator_gear[:, 0]
        return stiffness, np.sqrt(2 * inertia * stiffness / gear)

    def _posture(self, qpos: jax.Array, place: jax.Array) -> jax.Array:
        """Returns joint angles [2] (rad) that bring the fingertip to a place [2] (m), or as near as the arm reaches.

        Of the two solutions, elbow to the left and to the right, it is the one that is nearer to the angles `qpos`.
        """
        x, y = place
        upper, lower = jnp.linalg.norm(self._links, axis=-1)
        cosine = (x**2 + y**2 - upper**2 - lower**2) / (2 * upper * lower)
        elbow = jnp.arccos(jnp.clip(cosine, -1, 1)) * jnp.array([1.0, -1.0])
        shoulder = jnp.arctan2(y, x) - jnp.arctan2(lower * jnp.sin(elbow), upper + lower * jnp.cos(elbow))
        shoulder = (shoulder + jnp.pi) % (2 * jnp.pi) - jnp.pi
        postures = jnp.stack([shoulder, elbow], axis=-1)
        return postures[jnp.argmin(jnp.square(postures - qpos).sum(axis=-1))]

    def success(self, task: ReachTask, states: State) -> jax.Array:
        """Tells whether the fingertip touched the target in one of the last LAST_STEPS steps (paper, Appendix A)."""
        last = jax.tree.map(lambda x: x[-LAST_STEPS:], states)
        gap = jax.vmap(self.off_target, in_axes=(None, 0))(task, last)
        return jnp.any(jnp.linalg.norm(gap, axis=-1) < TOUCH)

    def task_blind(self, key: jax.Array, task: ReachTask) -> ReachTask:
        """Makes a random cube the target."""
        return dataclasses.replace(task, target=jax.random.randint(key, (), 0, NUM_OBJECTS))


def _arm() -> mujoco.MjModel:
    """Compiles the arm without cubes, table and walls. Contacts are disabled, so they do not affect its motion."""
    spec = mujoco.MjSpec.from_file(str(ASSETS / "reach.xml"))
    for element in [*spec.worldbody.geoms, *(body for body in spec.bodies if body.mocap)]:
        spec.delete(element)
    return spec.compile()


def _draw_positions(key: jax.Array) -> jax.Array:
    """Samples [_CANDIDATES, 3, 2] positions in the arena (m).

    Three keep the distances with probability 0.31, or 0.23 if one must stand in the middle, so one of 64 always does.
    """
    return jax.random.uniform(key, (_CANDIDATES, NUM_OBJECTS, 2), minval=-EXTENT, maxval=EXTENT)


def _draw_colors(key: jax.Array, split: str) -> jax.Array:
    """Samples three different colors of the split's grid: [3, 3]."""
    index = jax.random.choice(key, 1000, (NUM_OBJECTS,), replace=False)
    grid = jnp.stack([index // 100, index // 10 % 10, index % 10], axis=-1).astype(float)
    return grid * 0.1 + COLOR_OFFSETS[split]


class ReachState(Reach):
    """Reach without a camera: the state also tells where the three cubes stand, in the task's order.

    The state is 14-dimensional: the 8 entries of `Reach`, then x and y (m) of each cube. The target is the same one of
    the three in all scenes of a task, and any of them in another task: only a demonstration tells which.
    """

    name = "reach_state"
    state_size = 14
    vision = False
    object_indices = ((8, 9), (10, 11), (12, 13))

    def robot_state(self, state: State) -> jax.Array:
        """Returns [14]: the robot's 8, then the cubes' x and y."""
        return jnp.concatenate([super().robot_state(state), state.mocap_pos[:, :2].ravel()])
