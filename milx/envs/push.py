"""Push: a seven-joint arm pushes one of two things onto a red disc, by torques (paper, Section 6.2)."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from milx.envs.base import ASSETS, Env, State, check_split
from milx.envs.shapes import SHAPES, SPLITS
from milx.envs.shapes import primitives as shapes

GOAL_RADIUS = 0.08
"""The red disc's (m); its centre is at x = y = 0."""
STEPS_ON_GOAL = 10
"""So many of the episode's steps the thing must be on the disc."""
LOW, HIGH = (-0.3, -0.2), (0.0, 0.2)
"""Where things start: least and greatest x and y (m)."""
FROM_GOAL = 0.17
"""Least distance of a thing's start from the goal (m)."""
SPACING = 0.15
"""Least distance between the things' starts (m), which lie on opposite sides of the middle."""
SIZE = (0.038, 0.052)
"""Unit of length of the shapes (m), drawn uniformly."""
MASS = (0.2, 1.0)
"""Of a thing (kg), drawn uniformly."""
DAMPING = (0.2, 5.0)
"""Of a thing's sliding (N s/m), drawn uniformly."""
NUM_JOINTS = 7
_START = (0.0, -0.927, 0.0, 2.402, 0.0, 0.096, 0.0)
_THINGS = ("thing_0", "thing_1")
_PRONGS = ("prong_left", "prong_middle", "prong_right")
_CANDIDATES = 64


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PushTask:
    """Two things, and which of them is to be pushed.

    Attributes:
        target: int32, 0 or 1.
        shape: [2] int32, index into SHAPES of each thing.
        size: [2] unit of length of its shape (m).
        mass: [2] kg.
        damping: [2] N s/m of viscous friction when it slides; friction against turning follows from its outline.
        color: [2, 3] RGB in [0, 1].
    """

    target: jax.Array
    shape: jax.Array
    size: jax.Array
    mass: jax.Array
    damping: jax.Array
    color: jax.Array


class Push(Env):
    """Seven torque-controlled joints, two things that slide and turn, 125x125 pixels, 100 actions of 0.05 s.

    The robot's state is 20-dimensional: seven joint angles (rad), seven joint velocities (rad/s), the position of the
    hand's tip (m) and the unit vector in which the hand pushes. An action is seven motor commands in [-1, 1], of 2 N m
    each.
    """

    name = "push"
    horizon = 100
    substeps = 5
    image_shape = (125, 125)
    camera = "front"
    criterion = f"centre on the goal disc for at least {STEPS_ON_GOAL} of 100 steps"
    state_size = 20
    goal_indices = (14, 15)

    def __init__(self, image_shape: tuple[int, int] | None = None):
        super().__init__(_build(), image_shape)
        model = self.mj_model
        self._rgba = jnp.asarray(model.geom_rgba, float)
        self._tip, self._hand = model.site("tip").id, model.body("hand").id
        self._body = np.array([model.body(name).id for name in _THINGS])
        self._dof = np.array([model.jnt_dofadr[model.body_jntadr[body]] + np.arange(3) for body in self._body])
        self._geom = np.array([model.body_geomadr[body] + np.arange(model.body_geomnum[body]) for body in self._body])
        catalogue = [shapes.geoms(shape) for shape in SHAPES.values()]
        self._pos, self._quat, self._size, self._seen, self._gyration = (
            jnp.asarray(np.array(column)) for column in zip(*catalogue, strict=True)
        )

    def sample_task(self, key: jax.Array, split: str) -> PushTask:
        """Draws two different shapes of the split, their sizes, masses, friction and colours, and the target."""
        check_split(split)
        names = list(SHAPES)
        indices = jnp.array([names.index(name) for name in SPLITS[split]])
        shape_key, target_key, size_key, mass_key, damping_key, color_key = jax.random.split(key, 6)
        draw = lambda key, limits: jax.random.uniform(key, (2,), minval=limits[0], maxval=limits[1])  # noqa: E731
        return PushTask(
            target=jax.random.randint(target_key, (), 0, 2),
            shape=jax.random.choice(shape_key, indices, (2,), replace=False),
            size=draw(size_key, SIZE),
            mass=draw(mass_key, MASS),
            damping=draw(damping_key, DAMPING),
            color=jax.random.uniform(color_key, (2, 3)),
        )

    def redraw_appearance(self, key: jax.Array, task: PushTask) -> PushTask:
        """The same things in other colours."""
        return dataclasses.replace(task, color=jax.random.uniform(key, (2, 3)))

    def redraw_scene(self, key: jax.Array, task: PushTask, states: State) -> State:
        """The same states: both things may have been touched."""
        return states

    def reset(self, key: jax.Array, task: PushTask) -> State:
        """Stands the hand before the table's middle, and the things on either side of it, turned at random."""
        place_key, side_key, turn_key = jax.random.split(key, 3)
        low, high = jnp.array(LOW), jnp.array(HIGH)
        place = jax.random.uniform(place_key, (_CANDIDATES, 2, 2), minval=low, maxval=high)
        side = jnp.where(jax.random.bernoulli(side_key), 1.0, -1.0) * jnp.array([1.0, -1.0])
        place = place.at[..., 1].set(side * jnp.abs(place[..., 1]))
        from_goal = jnp.linalg.norm(place, axis=-1).min(axis=-1) > FROM_GOAL
        apart = jnp.linalg.norm(place[:, 0] - place[:, 1], axis=-1) > SPACING
        first = place[jnp.argmax(from_goal & apart)]  # one of two draws keeps the distances, so one of 64 always does
        turn = jax.random.uniform(turn_key, (2, 1), minval=-jnp.pi, maxval=jnp.pi)
        things = jnp.concatenate([first, turn], axis=-1).ravel()
        qpos = jnp.concatenate([jnp.array(_START), things])
        return State(qpos, jnp.zeros_like(qpos), jnp.zeros((0, 3)))

    @functools.partial(jax.jit, static_argnums=0)
    def model_of(self, task: PushTask) -> mjx.Model:
        """The model with the task's things: their geoms, masses, inertias and friction."""
        model, unit = self.model, task.size[:, None, None]
        things, geoms, dofs = self._body, self._geom, self._dof
        inertia = task.mass * self._gyration[task.shape] * task.size**2
        per_mass = jnp.stack([2 / task.mass, 1 / inertia], axis=-1) / 3
        friction = jnp.stack([jnp.ones(2), jnp.ones(2), self._gyration[task.shape] * task.size**2], axis=-1)
        return model.replace(
            geom_pos=model.geom_pos.at[geoms].set(unit * self._pos[task.shape]),
            geom_quat=model.geom_quat.at[geoms].set(self._quat[task.shape]),
            geom_size=model.geom_size.at[geoms].set(unit * self._size[task.shape]),
            body_mass=model.body_mass.at[things].set(task.mass),
            body_subtreemass=model.body_subtreemass.at[things].set(task.mass),
            body_inertia=model.body_inertia.at[things].set(inertia[:, None]),
            body_invweight0=model.body_invweight0.at[things].set(per_mass),
            dof_damping=model.dof_damping.at[dofs].set(task.damping[:, None] * friction),
        )

    def things(self, state: State) -> jax.Array:
        """[2, 3] x, y (m) and turn (rad) of both things."""
        return state.qpos[NUM_JOINTS:].reshape(2, 3)

    @functools.partial(jax.jit, static_argnums=0)
    def hand(self, qpos: jax.Array) -> jax.Array:
        """[9] position of the hand's tip (m), the way the hand pushes and the way its prongs point, for all joints."""
        data = mjx.kinematics(self.model, self._data.replace(qpos=qpos))
        pose = data.xmat[self._hand].reshape(3, 3)
        return jnp.concatenate([data.site_xpos[self._tip], pose[:, 2], pose[:, 0]])

    def robot_state(self, state: State) -> jax.Array:
        """[20] joint angles, joint velocities, tip position, direction of pushing."""
        return jnp.concatenate([state.qpos[:NUM_JOINTS], state.qvel[:NUM_JOINTS], self.hand(state.qpos)[:6]])

    def colors(self, task: PushTask) -> jax.Array:
        """[G, 4] RGBA of every geom; what a shape does not use is transparent."""
        seen = self._seen[task.shape].astype(float)
        color = jnp.broadcast_to(task.color[:, None], (*seen.shape, 3))
        return self._rgba.at[self._geom].set(jnp.concatenate([color, seen[..., None]], axis=-1))

    def running_residual(self, task: PushTask, state: State, action: jax.Array, t: jax.Array) -> jax.Array:
        """[12] the released code's reward as residuals: thing off goal, tip off thing (m), and action, weighted."""
        thing, tip = self.things(state)[task.target, :2], self.hand(state.qpos)[:3]
        off = tip - jnp.append(thing, 0.02)
        return jnp.concatenate([thing, 0.5 * off, 0.1 * action])

    def terminal_residual(self, task: PushTask, state: State) -> jax.Array:
        """[2] thing off goal (m), weighted."""
        return 10.0 * self.things(state)[task.target, :2]

    def steps_near_goal(self, task: PushTask, states: State, radius: float) -> jax.Array:
        """In how many of the steps the target's centre is closer to the goal's than `radius` (m)."""
        place = jax.vmap(self.things)(jax.tree.map(lambda x: x[1:], states))[:, task.target, :2]
        return (jnp.linalg.norm(place, axis=-1) < radius).sum()

    def success(self, task: PushTask, states: State) -> jax.Array:
        """Whether the target's centre was on the disc for at least STEPS_ON_GOAL steps (paper, Section 6.2)."""
        return self.steps_near_goal(task, states, GOAL_RADIUS) >= STEPS_ON_GOAL

    def task_blind(self, key: jax.Array, task: PushTask) -> PushTask:
        """The task with a random thing as the target."""
        return dataclasses.replace(task, target=jax.random.randint(key, (), 0, 2))


def _build() -> mujoco.MjModel:
    """The arm and the table, with two things whose geoms every task sets anew."""
    spec = mujoco.MjSpec.from_file(str(ASSETS / "push.xml"))
    types = mujoco.mjtGeom
    slots = (
        (types.mjGEOM_CAPSULE, shapes.NUM_STICKS),
        (types.mjGEOM_ELLIPSOID, shapes.NUM_EGGS),
        (types.mjGEOM_BOX, shapes.NUM_BOXES),
        (types.mjGEOM_CYLINDER, shapes.NUM_DRUMS),
    )
    for thing, y in zip(_THINGS, (0.15, -0.15), strict=True):
        body = spec.worldbody.add_body(
            name=thing, pos=[0, 0, 0], mass=1.0, inertia=[1, 1, 1], explicitinertial=True, ipos=[0, 0, 0]
        )
        hinge, slide = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
        for name, kind, axis in (("x", slide, [1, 0, 0]), ("y", slide, [0, 1, 0]), ("turn", hinge, [0, 0, 1])):
            body.add_joint(name=f"{thing}_{name}", type=kind, axis=axis, damping=1.0, armature=0.0)
        for kind, count in slots:
            for i in range(count):
                body.add_geom(name=f"{thing}_{kind.name[7:].lower()}_{i}", type=kind, size=[0.02] * 3, pos=[0, y, 0.02])
        for prong in _PRONGS:
            for i in range(shapes.NUM_STICKS):
                spec.add_pair(geomname1=prong, geomname2=f"{thing}_capsule_{i}", condim=1)
    return spec.compile()
