"""Push: a seven-joint arm pushes one of two objects onto a red disc, by torques (paper, Section 6.2)."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from milx.core.mjx import mjx
from milx.envs.base import ASSETS, OUT_OF_THE_WAY, Env, State, check_split
from milx.envs.chain import Chain
from milx.envs.push import steering
from milx.envs.shapes import BY_SPLIT, SHAPES
from milx.envs.shapes.primitives import NUM_CAPSULES, SLOTS, Geoms, to_geoms
from milx.envs.steering import Steering
from milx.render import textures
from milx.render.textures import Textures

GOAL_RADIUS = 0.08
"""Radius of the red disc (m); its center is at x = y = 0."""
NEAR_GOAL = 0.13
"""The paper's released code counts steps in which the object is this close to the goal (m)."""
STEPS_ON_GOAL = 10
"""Number of the episode's steps in which the object must be on the disc."""
LOW, HIGH = (-0.3, -0.2), (0.0, 0.2)
"""Where objects start: minimum and maximum x and y (m)."""
FROM_GOAL = 0.17
"""Minimum distance of an object's start from the goal (m)."""
SPACING = 0.15
"""Minimum distance between the objects' centers at the start (m; paper: 0.1). They lie on opposite sides."""
SIZE = (0.038, 0.052)
"""Unit of length of the shapes (m), drawn uniformly."""
MASS = (0.2, 1.0)
"""Mass of an object (kg), drawn uniformly."""
DAMPING = (0.2, 5.0)
"""Damping of an object's sliding (N s/m), drawn uniformly."""
BEHIND = 1.25
"""The hand comes down about this many times as far from the goal's center as the object is."""
NUM_JOINTS = 7
_START = (0.0, -0.895, 0.0, 2.397, 0.0, 0.069, 0.0)
OBJECT_COST, TIP_COST, HEIGHT_COST, FINAL_COST = 1.0, 0.5, 2.0, 10.0
"""Weights of the residuals (1/m)."""
PUSH_HEIGHT = 0.01
"""Height of the tip (m) at which the hand is to push."""
MISJUDGED = 0.015
"""Standard deviation of the error in where an expert that learns supposes the objects (m)."""
_DIRECTIONS = np.stack([np.cos(np.arange(8) * np.pi / 4), np.sin(np.arange(8) * np.pi / 4)], axis=-1)
"""In which an expert that learns is told the target's outline."""
_OBJECTS = ("object_0", "object_1")
_PRONGS = ("prong_left", "prong_middle", "prong_right")
_CANDIDATES = 64
_FEWER_STEPS = 3
"""Physics steps of an action, for planners."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PushTask:
    """Two objects, and which of them is to be pushed.

    Attributes:
        target: int32, 0 or 1.
        shape: [2] int32, index into SHAPES of each object.
        size: [2] unit of length of its shape (m).
        mass: [2] kg.
        damping: [2] N s/m of viscous friction when it slides; friction against turning follows from its outline.
        color: [2, 3] RGB in [0, 1].
        texture: [2], with frames that take the object's.
    """

    target: jax.Array
    shape: jax.Array
    size: jax.Array
    mass: jax.Array
    damping: jax.Array
    color: jax.Array
    texture: Textures


class Push(Env[PushTask]):
    """Seven torque-controlled joints, two objects that slide and turn, 125x125 pixels, 100 actions of 0.05 s.

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
    height_index = 16
    action_cost = 0.1
    version = 4

    def __init__(self, image_shape: tuple[int, int] | None = None):
        super().__init__(_build(), image_shape)
        model = self.mj_model
        self._rgba = jnp.asarray(model.geom_rgba, float)
        self._arm = Chain(model, "tip")
        self._body = np.array([model.body(name).id for name in _OBJECTS])
        self._dof = np.array([model.jnt_dofadr[model.body_jntadr[body]] + np.arange(3) for body in self._body])
        self._geom = np.array([model.body_geomadr[body] + np.arange(model.body_geomnum[body]) for body in self._body])
        shapes = [to_geoms(shape) for shape in SHAPES.values()]
        self._shapes = jax.tree.map(lambda *x: jnp.asarray(np.array(x)), *shapes)

    def sample_task(self, key: jax.Array, split: str) -> PushTask:
        """Draws two different shapes of the split, their sizes, masses, friction and looks, and the target.

        Raises:
            ValueError: for a split that does not exist.
        """
        check_split(split)
        names = list(SHAPES)
        indices = jnp.array([names.index(name) for name in BY_SPLIT[split]])
        shape_key, target_key, size_key, mass_key, damping_key, look_key = jax.random.split(key, 6)
        draw = lambda key, limits: jax.random.uniform(key, (2,), minval=limits[0], maxval=limits[1])  # noqa: E731
        return PushTask(
            target=jax.random.randint(target_key, (), 0, 2),
            shape=jax.random.choice(shape_key, indices, (2,), replace=False),
            size=draw(size_key, SIZE),
            mass=draw(mass_key, MASS),
            damping=draw(damping_key, DAMPING),
            **textures.draw_looks(look_key, split, 2),
        )

    def redraw_appearance(self, key: jax.Array, task: PushTask) -> PushTask:
        """Gives the same objects other colors and textures."""
        return dataclasses.replace(task, **textures.draw_looks(key, "train", 2))

    def redraw_scene(self, key: jax.Array, task: PushTask, states: State) -> State:
        """Returns the same states: both objects may have been touched."""
        return states

    def reset(self, key: jax.Array, task: PushTask) -> State:
        """Stands the hand before the table's middle, and the objects on either side of it, turned at random.

        Both are drawn from the same distribution, so that the place does not tell the target.
        """
        place_key, side_key, turn_key = jax.random.split(key, 3)
        low, high = jnp.array(LOW), jnp.array(HIGH)
        place = jax.random.uniform(place_key, (_CANDIDATES, 2, 2), minval=low, maxval=high)
        side = jnp.where(jax.random.bernoulli(side_key), 1.0, -1.0) * jnp.array([1.0, -1.0])
        place = place.at[..., 1].set(side * jnp.abs(place[..., 1]))
        from_goal = jnp.linalg.norm(place, axis=-1).min(axis=-1) > FROM_GOAL
        apart = jnp.linalg.norm(place[:, 0] - place[:, 1], axis=-1) > SPACING
        # A third of the draws keep the distances, so one of 64 always does.
        first = place[jnp.argmax(from_goal & apart)]
        turn = jax.random.uniform(turn_key, (2, 1), minval=-jnp.pi, maxval=jnp.pi)
        objects = jnp.concatenate([first, turn], axis=-1).ravel()
        qpos = jnp.concatenate([jnp.array(_START), objects])
        return State(qpos, jnp.zeros_like(qpos), jnp.zeros((0, 3)))

    @property
    def image_to_goal(self) -> np.ndarray:
        """The goal head looks for the target, and the hand comes down behind it."""
        return BEHIND * self.image_to_plane(LOW, HIGH, 0.02)

    @functools.partial(jax.jit, static_argnums=0)
    def model_of(self, task: PushTask) -> mjx.Model:
        """Sets the geoms, masses, inertias and friction of the task's objects in the model."""
        model, unit, shapes = self.model, task.size[:, None, None], self._shapes_of(task)
        objects, geoms, dofs = self._body, self._geom, self._dof
        # A plate on a viscous table: what holds for a point holds for turning, times the mean squared lever.
        lever = shapes.squared_gyration * task.size**2
        inertia = task.mass * lever
        inverse = jnp.stack([2 / task.mass, 1 / inertia], axis=-1) / 3  # of two slides and one hinge, over three axes
        pos = jnp.where(shapes.used[..., None], unit * shapes.pos, jnp.array(OUT_OF_THE_WAY))
        return model.replace(
            geom_pos=model.geom_pos.at[geoms].set(pos),
            geom_quat=model.geom_quat.at[geoms].set(shapes.quat),
            geom_size=model.geom_size.at[geoms].set(unit * shapes.size),
            body_mass=model.body_mass.at[objects].set(task.mass),
            body_subtreemass=model.body_subtreemass.at[objects].set(task.mass),
            body_inertia=model.body_inertia.at[objects].set(inertia[:, None]),
            body_invweight0=model.body_invweight0.at[objects].set(inverse),
            dof_damping=model.dof_damping.at[dofs].set(
                task.damping[:, None] * jnp.stack([jnp.ones(2), jnp.ones(2), lever], axis=-1)
            ),
        )

    def _shapes_of(self, task: PushTask) -> Geoms:
        """Returns the geoms of the task's two objects, with a leading axis of 2."""
        return jax.tree.map(lambda x: x[task.shape], self._shapes)

    def target_kind(self, task: PushTask) -> jax.Array:
        """Returns the target's shape, an index into SHAPES."""
        return task.shape[task.target]

    def objects(self, state: State) -> jax.Array:
        """Returns [2, 3] x, y (m) and turn (rad) of both objects."""
        return state.qpos[NUM_JOINTS:].reshape(2, 3)

    @functools.partial(jax.jit, static_argnums=0)
    def hand(self, qpos: jax.Array) -> jax.Array:
        """Returns [9]: tip position (m), unit vectors of the hand pushing and of its prongs, at joints [7, ...]."""
        tip, axes, _ = self._arm.pose(qpos[:NUM_JOINTS])
        return jnp.concatenate([tip, axes[:, 2], axes[:, 0]])

    def robot_state(self, state: State) -> jax.Array:
        """Returns [20] joint angles, joint velocities, tip position, and direction of pushing."""
        return jnp.concatenate([state.qpos[:NUM_JOINTS], state.qvel[:NUM_JOINTS], self.hand(state.qpos)[:6]])

    def colors(self, task: PushTask) -> jax.Array:
        """Returns [G, 4] RGBA of every geom; what a shape does not use is transparent."""
        seen = self._shapes_of(task).seen.astype(float)
        color = jnp.broadcast_to(task.color[:, None], (*seen.shape, 3))
        return self._rgba.at[self._geom].set(jnp.concatenate([color, seen[..., None]], axis=-1))

    def textures(self, task: PushTask, data: mjx.Data) -> Textures:
        """Returns the textures [G] of the objects; all else is plain."""
        return textures.on_geoms(task.texture, self._body, self.mj_model.geom_bodyid, data.xpos, data.xmat)

    @property
    def steering(self) -> Steering:
        """The hand's velocity [4] along x, y and z (m/s), and its turning about z (rad/s)."""
        return steering.hand_velocity(self)

    @functools.partial(jax.jit, static_argnums=0)
    def approximate_step(self, task: PushTask, state: State, action: jax.Array) -> State:
        """Takes three physics steps instead of five, with two iterations of the contact solver instead of six.

        Each of its line searches evaluates at most four points instead of eight. iLQR differentiates these steps, too.
        """
        model = self.model_of(task)
        timestep = jnp.asarray(self.substeps * self.mj_model.opt.timestep / _FEWER_STEPS, float)
        cheaper = model.opt.replace(iterations=2, ls_iterations=4, timestep=timestep)
        return self._advance(model.replace(opt=cheaper), state, action, _FEWER_STEPS)

    def misjudge(self, key: jax.Array, state: State) -> State:
        """Moves both objects by errors of a normal distribution in x and y."""
        error = jnp.pad(MISJUDGED * jax.random.normal(key, (2, 2)), ((0, 0), (0, 1)))
        return dataclasses.replace(state, qpos=state.qpos.at[NUM_JOINTS:].add(error.ravel()))

    def visible(self, task: PushTask, state: State) -> jax.Array:
        """Returns [8], how far the target reaches from its center in eight directions (m)."""
        return self.outline(task, state, jnp.asarray(_DIRECTIONS, float))

    def outline(self, task: PushTask, state: State, directions: jax.Array) -> jax.Array:
        """Returns [D], how far the target reaches from its center in directions [D, 2] of the world (m)."""
        turn, shape = self.objects(state)[task.target, 2], jax.tree.map(lambda x: x[task.target], self._shapes_of(task))
        cos, sin = jnp.cos(turn), jnp.sin(turn)
        along = shape.ends @ (jnp.array([[cos, sin], [-sin, cos]]) @ directions.T)  # as the object sees them
        return task.size[task.target] * (along.max(axis=1) + shape.radius[:, None]).max(axis=0)

    def running_residual(self, task: PushTask, state: State, action: jax.Array, t: jax.Array) -> jax.Array:
        """Returns [12]: object from goal, tip from object, the tip's height (m), and the action; weighted.

        The released code's reward has the norms of the first two and of the action instead of their squares. The height
        is measured from that at which the hand pushes, since no table holds it up.
        """
        place, tip = self.objects(state)[task.target, :2], self.hand(state.qpos)[:3]
        height = HEIGHT_COST * (tip[2:] - PUSH_HEIGHT)
        return jnp.concatenate([OBJECT_COST * place, TIP_COST * (tip[:2] - place), height, self.action_cost * action])

    def terminal_residual(self, task: PushTask, state: State) -> jax.Array:
        """Returns [2]: the object's distance from the goal (m), weighted."""
        return FINAL_COST * self.objects(state)[task.target, :2]

    def steps_near_goal(self, task: PushTask, states: State, radius: float) -> jax.Array:
        """Counts the steps in which the target's center is closer to the goal's than `radius` (m)."""
        place = jax.vmap(self.objects)(jax.tree.map(lambda x: x[1:], states))[:, task.target, :2]
        return (jnp.linalg.norm(place, axis=-1) < radius).sum()

    def success(self, task: PushTask, states: State) -> jax.Array:
        """Tells whether the target's center was on the disc for at least STEPS_ON_GOAL steps (paper, Section 6.2)."""
        return self.steps_near_goal(task, states, GOAL_RADIUS) >= STEPS_ON_GOAL

    def other_criteria(self, task: PushTask, states: State) -> dict[str, jax.Array]:
        """Judges the episode by the criterion of the paper's released code."""
        near = self.steps_near_goal(task, states, NEAR_GOAL)
        return {f"within {NEAR_GOAL} m of the goal for at least {STEPS_ON_GOAL} of 100 steps": near >= STEPS_ON_GOAL}

    def task_blind(self, key: jax.Array, task: PushTask) -> PushTask:
        """Makes a random object the target."""
        return dataclasses.replace(task, target=jax.random.randint(key, (), 0, 2))


def _build() -> mujoco.MjModel:
    """Builds the arm and the table, with two objects whose geoms every task sets anew."""
    spec = mujoco.MjSpec.from_file(str(ASSETS / "push.xml"))
    hinge, slide = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    for name in _OBJECTS:
        body = spec.worldbody.add_body(name=name, mass=1.0, inertia=[1, 1, 1], explicitinertial=True)
        for joint, kind, axis in (("x", slide, [1, 0, 0]), ("y", slide, [0, 1, 0]), ("turn", hinge, [0, 0, 1])):
            body.add_joint(name=f"{name}_{joint}", type=kind, axis=axis, damping=1.0, armature=0.0)
        for kind, count in SLOTS.items():
            for i in range(count):
                geom_type = getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
                body.add_geom(name=f"{name}_{kind}_{i}", type=geom_type, size=[0.02] * 3)
        for prong in _PRONGS:
            for i in range(NUM_CAPSULES):
                spec.add_pair(geomname1=prong, geomname2=f"{name}_capsule_{i}", condim=1)
    return spec.compile()
