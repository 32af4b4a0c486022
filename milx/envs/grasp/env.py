"""Grasp: a hand with two fingers takes a thing from the table and puts it on one of three mats on a shelf."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from milx.core.mjx import mjx
from milx.envs import shapes
from milx.envs.base import ASSETS, Env, State, check_split
from milx.envs.layout import first_spaced
from milx.envs.shapes import SHAPES, primitives
from milx.envs.shapes.primitives import NUM_CAPSULES, SLOTS, Geoms
from milx.envs.steering import Steering
from milx.render import textures
from milx.render.textures import Textures

NUM_MATS = 3
SHELF = 0.04
"""Height of the shelf over the table (m)."""
LOW, HIGH = (-0.19, -0.2), (-0.06, 0.2)
"""Where things lie: minimum and maximum x and y (m)."""
MATS_LOW, MATS_HIGH = (0.115, -0.26), (0.215, 0.26)
"""Where mats lie: minimum and maximum x and y of their centers (m)."""
SPACING = 0.13
"""Minimum distance between two mats' centers (m)."""
HAND_LOW, HAND_HIGH = (-0.19, -0.1, 0.1), (-0.06, 0.1, 0.15)
"""Where the hand starts: minimum and maximum x, y and z (m)."""
THING_SIZE, MAT_SIZE = (0.024, 0.03), (0.036, 0.042)
"""Units of length of the shapes of things and mats (m), drawn uniformly."""
MAT_HEIGHT = 0.004
"""How far a mat stands out from the shelf (m), into which the capsules of its outline are sunk."""
MASS, INERTIA = 0.1, 5e-5
"""Of every thing (kg, kg m^2)."""
SUNK, ROLLING = 0.004, 2e-4
"""How far the center of mass is below the middle (m), and damping of turning (N m s/rad): else round things roll."""
ON_MAT, RESTING, STILL, OPEN = 0.05, 0.008, 0.05, 0.025
"""What success allows: distances from the mat's center and from the height at which things rest (m), speed (m/s), and
the least opening of a finger (m)."""
PLACED = 0.03, 0.006
"""How near the mat's center, and how low over its place there, the hand is to open, and to leave the thing (m)."""
THING_COST, HEIGHT_COST, HAND_COST, OPEN_COST = 3.0, 15.0, 6.0, 10.0
"""Weights of the residuals (1/m)."""
SPEED_COST, SPIN_COST, TILT_COST = 1.0, 0.03, 3.0
"""Weights of the thing's velocity (s/m) and turning (s/rad), and of the sine of half the angle by which it tilts."""
CARRIED, NEAR, FAR = 0.07, 0.024, 0.104
"""How high over its place the thing is to be carried where it is farther away than FAR as seen from above (m); nearer
it is to come down, and to lie where it is nearer than NEAR."""
RETREAT = 0.06
"""How high over the thing the hand is to leave it (m)."""
MAX_SPEED = 0.3
"""What an action of 1 asks of the hand (m/s)."""
TRACKING = 6.0
"""Rate at which the hand returns to its path (1/s)."""
_HAND, _FINGER, _THING = slice(0, 3), 3, slice(5, 8)  # entries of qpos, and of qvel
_TILT, _MOTION = slice(9, 11), slice(5, 11)  # entries of qpos; entries of qvel
_CANDIDATES = 256
_GRAIN = 1e-3


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class GraspTask:
    """A thing, three mats, and on which of them it is to be put.

    Attributes:
        target: int32, 0 to 2.
        thing: int32, index into SHAPES.
        thing_size: its unit of length (m).
        mat: [3] int32, index into SHAPES of each mat's outline.
        mat_size: [3] their units of length (m).
        color: [4, 3] RGB in [0, 1] of the thing and of the mats.
        texture: [4] theirs, with frames that take the body's.
    """

    target: jax.Array
    thing: jax.Array
    thing_size: jax.Array
    mat: jax.Array
    mat_size: jax.Array
    color: jax.Array
    texture: Textures


class Grasp(Env[GraspTask]):
    """A hand moved by velocities, a free thing, three mats, 100x90 pixels, 80 actions of 0.05 s.

    The robot's state is 8-dimensional: the hand's x, y and z, how far a finger is open (m), and their velocities. An
    action is the hand's velocity, in [-1, 1] for MAX_SPEED, and how the fingers close, from -1, open, to 1. In a mirror
    the fingers are exchanged, which are equally far open but for the give of a constraint.
    """

    name = "grasp"
    horizon = 80
    substeps = 5
    image_shape = (90, 100)
    camera = "front"
    criterion = f"at the end the thing lies still within {ON_MAT} m of the target mat's center and the hand is open"
    goal_indices = (0, 1)
    ahead = 20
    mirror = (1, -1, 1, 1, 1, -1, 1, 1), (1, -1, 1, 1)
    action_cost = 0.02
    version = 6

    def __init__(self, image_shape: tuple[int, int] | None = None):
        super().__init__(_build(), image_shape)
        model = self.mj_model
        self._rgba = jnp.asarray(model.geom_rgba, float)
        self._body = np.array([model.body(name).id for name in ("thing", *_mat_names())])
        self._geom = [model.body_geomadr[body] + np.arange(model.body_geomnum[body]) for body in self._body]
        geoms = [primitives.to_geoms(shape) for shape in SHAPES.values()]
        self._shapes: Geoms = jax.tree.map(lambda *x: jnp.asarray(np.array(x)), *geoms)

    @property
    def image_to_goal(self) -> np.ndarray:
        """The hand ends over the middle of a mat."""
        return self.image_to_plane(MATS_LOW, MATS_HIGH, SHELF)

    def sample_task(self, key: jax.Array, split: str) -> GraspTask:
        """Draws a thing and three mats of different outlines of the split, their sizes and looks, and the target.

        Raises:
            ValueError: for a split that does not exist.
        """
        check_split(split)
        keys, names = jax.random.split(key, 5), list(SHAPES)
        indices = jnp.array([names.index(name) for name in shapes.BY_SPLIT[split]])
        thing, *mat = jax.random.choice(keys[1], indices, (1 + NUM_MATS,), replace=False)
        return GraspTask(
            target=jax.random.randint(keys[0], (), 0, NUM_MATS),
            thing=thing,
            thing_size=jax.random.uniform(keys[2], minval=THING_SIZE[0], maxval=THING_SIZE[1]),
            mat=jnp.stack(mat),
            mat_size=jax.random.uniform(keys[3], (NUM_MATS,), minval=MAT_SIZE[0], maxval=MAT_SIZE[1]),
            **textures.draw_looks(keys[4], split, 1 + NUM_MATS),
        )

    def redraw_appearance(self, key: jax.Array, task: GraspTask) -> GraspTask:
        """Gives the same thing and mats other colors and textures."""
        return dataclasses.replace(task, **textures.draw_looks(key, "train", 1 + NUM_MATS))

    def reset(self, key: jax.Array, task: GraspTask) -> State:
        """Lays the thing on the table, turned at random, the mats on the shelf, and hangs the open hand over both."""
        place_key, turn_key, hand_key, mat_key = jax.random.split(key, 4)
        place = jax.random.uniform(place_key, (2,), minval=jnp.array(LOW), maxval=jnp.array(HIGH))
        half = jax.random.uniform(turn_key, minval=-jnp.pi, maxval=jnp.pi) / 2
        hand = jax.random.uniform(hand_key, (3,), minval=jnp.array(HAND_LOW), maxval=jnp.array(HAND_HIGH))
        opened = self.mj_model.jnt_range[_FINGER, 1]
        thing = jnp.stack([*place, self.resting(task), jnp.cos(half), 0.0, 0.0, jnp.sin(half)])
        qpos = jnp.concatenate([hand, jnp.array([opened, opened]), thing])
        ground = jnp.full((NUM_MATS, 1), SHELF)
        mats = jnp.concatenate([first_spaced(_draw_places(mat_key), SPACING), ground], axis=-1)
        return State(qpos, jnp.zeros(self.mj_model.nv), mats)

    def redraw_scene(self, key: jax.Array, task: GraspTask, states: State) -> State:
        """Keeps the motion and the target, and moves the two other mats elsewhere."""
        target = states.mocap_pos[0, task.target, :2]
        place = first_spaced(_draw_places(key).at[:, task.target].set(target), SPACING)
        return dataclasses.replace(states, mocap_pos=states.mocap_pos.at[..., :2].set(place))

    def resting(self, task: GraspTask) -> jax.Array:
        """Returns the height over the ground (m) of the middle of a thing that lies on it."""
        return task.thing_size * self._shape(task.thing).pos[0, 2]

    @property
    def steering(self) -> Steering:
        """The actions [4], where 0 opens the fingers; the hand returns to where it is expected."""
        opened, deviation = jnp.array([0, 0, 0, -0.6]), jnp.array([0.3, 0.3, 0.3, 0.6])

        def correction(state: State, expected: State) -> jax.Array:
            return jnp.pad(TRACKING * (expected.qpos[_HAND] - state.qpos[_HAND]) / MAX_SPEED, (0, 1))

        low, high = jnp.array([-1, -1, -1, -0.4]), jnp.array([1, 1, 1, 1.6])
        return Steering(low, high, deviation, lambda state, u: u + opened, correction)

    @functools.partial(jax.jit, static_argnums=0)
    def model_of(self, task: GraspTask) -> mjx.Model:
        """Sets the geoms of the task's thing and mats in the model."""
        model = self.model
        pos, quat, size = model.geom_pos, model.geom_quat, model.geom_size
        for geoms, (place, turn, extent, _) in zip(self._geom, self._geoms_of(task), strict=True):
            pos, quat, size = pos.at[geoms].set(place), quat.at[geoms].set(turn), size.at[geoms].set(extent)
        return model.replace(geom_pos=pos, geom_quat=quat, geom_size=size)

    def _geoms_of(self, task: GraspTask) -> list[tuple[Any, Any, Any, Any]]:
        """Returns position (m), quaternion, size (m) and visibility of the geoms of the thing and of each mat."""
        thing = self._shape(task.thing)
        # A capsule that a shape does not use is a grain within the first one: it moves with the thing.
        used = (thing.used | (jnp.arange(len(thing.used)) >= NUM_CAPSULES))[:, None]
        pos = jnp.where(used, thing.pos, thing.pos[0]).at[:, 2].add(-thing.pos[0, 2])
        size = jnp.where(used, task.thing_size * thing.size, _GRAIN)
        geoms = [(task.thing_size * pos, thing.quat, size, thing.seen)]
        for kind, unit in zip(task.mat, task.mat_size, strict=True):
            mat, capsules = self._shape(kind), slice(NUM_CAPSULES)
            size = unit * mat.size[capsules]
            pos = (unit * mat.pos[capsules]).at[:, 2].set(MAT_HEIGHT - size[:, 0])
            geoms.append((pos, mat.quat[capsules], size, mat.used[capsules]))
        return geoms

    def _shape(self, kind: jax.Array) -> Geoms:
        return jax.tree.map(lambda x: x[kind], self._shapes)

    def colors(self, task: GraspTask) -> jax.Array:
        """Returns [G, 4] RGBA of every geom; what a shape does not use is transparent."""
        rgba = self._rgba
        for geoms, color, (*_, seen) in zip(self._geom, task.color, self._geoms_of(task), strict=True):
            rgba = rgba.at[geoms].set(jnp.column_stack([jnp.broadcast_to(color, (len(geoms), 3)), seen]))
        return rgba

    def textures(self, task: GraspTask, data: mjx.Data) -> Textures:
        """Returns the textures [G] of the thing and the mats; all else is plain."""
        return textures.on_geoms(task.texture, self._body, self.mj_model.geom_bodyid, data.xpos, data.xmat)

    def target_kind(self, task: GraspTask) -> jax.Array:
        """Returns the outline of the target, an index into SHAPES."""
        return task.mat[task.target]

    def off_target(self, task: GraspTask, state: State) -> jax.Array:
        """Returns [3], from where the thing would rest on the middle of the target mat to where it is (m)."""
        return state.qpos[_THING] - state.mocap_pos[task.target].at[2].add(self.resting(task))

    def running_residual(self, task: GraspTask, state: State, action: jax.Array, t: jax.Array) -> jax.Array:
        """Returns [19]: how far thing, hand and fingers are off; tilt, motion of what is put down, action; weighted.

        The thing's height is compared with that at which it is to be carried, which falls to 0 near the mat. Where the
        thing is put down, the fingers are to be open and the hand RETREAT over it; elsewhere the hand is to be at the
        thing, and the fingers cost as much as if they were closed, so that it pays to put the thing down and let go.
        """
        *across, up = self.off_target(task, state)
        away = jnp.linalg.norm(jnp.stack(across) + 1e-6)
        carried = CARRIED * jnp.clip((away - NEAR) / (FAR - NEAR), 0.0, 1.0)
        placed = (away < PLACED[0]) & (up < PLACED[1])
        hand = (state.qpos[_HAND] - state.qpos[_THING]).at[2].add(jnp.where(placed, -RETREAT, 0.0))
        closed = self.mj_model.jnt_range[_FINGER, 1] - jnp.where(placed, state.qpos[_FINGER], 0.0)
        off = [THING_COST * x for x in across] + [HEIGHT_COST * (up - carried), OPEN_COST * closed]
        tilt = TILT_COST * state.qpos[_TILT]
        moving = jnp.where(placed, jnp.array([SPEED_COST] * 3 + [SPIN_COST] * 3), 0.0) * state.qvel[_MOTION]
        return jnp.concatenate([jnp.stack(off), HAND_COST * hand, tilt, moving, self.action_cost * action])

    def terminal_residual(self, task: GraspTask, state: State) -> jax.Array:
        """Returns [1], zero: a plan that ends earlier pays it, too, and must not let go of the thing for it."""
        return jnp.zeros(1)

    def success(self, task: GraspTask, states: State) -> jax.Array:
        """Tells whether the thing lies still on the target mat at the end, and the hand is open."""
        last = jax.tree.map(lambda x: x[-1], states)
        *across, up = self.off_target(task, last)
        on_mat = (jnp.linalg.norm(jnp.stack(across)) < ON_MAT) & (jnp.abs(up) < RESTING)
        still = jnp.linalg.norm(last.qvel[_THING]) < STILL
        return on_mat & still & (last.qpos[_FINGER] > OPEN)

    def task_blind(self, key: jax.Array, task: GraspTask) -> GraspTask:
        """Makes a random mat the target."""
        return dataclasses.replace(task, target=jax.random.randint(key, (), 0, NUM_MATS))


def _mat_names() -> list[str]:
    return [f"mat_{i}" for i in range(NUM_MATS)]


def _draw_places(key: jax.Array) -> jax.Array:
    """Samples [_CANDIDATES, 3, 2] positions on the shelf (m).

    Three keep the distances with probability 0.15, or 0.08 if one lies in the worst place, so one of 256 always does.
    """
    shape = (_CANDIDATES, NUM_MATS, 2)
    return jax.random.uniform(key, shape, minval=jnp.array(MATS_LOW), maxval=jnp.array(MATS_HIGH))


def _build() -> mujoco.MjModel:
    """Builds the hand, the table and the shelf, with a thing and mats whose geoms every task sets anew."""
    spec = mujoco.MjSpec.from_file(str(ASSETS / "grasp.xml"))
    thing = spec.worldbody.add_body(name="thing", mass=MASS, ipos=[0, 0, -SUNK], inertia=[INERTIA] * 3)
    thing.explicitinertial = True
    thing.add_freejoint()
    for kind, count in SLOTS.items():
        for i in range(count):
            geom_type = getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
            thing.add_geom(name=f"{kind}_{i}", type=geom_type, size=[0.02] * 3)
    for name in _mat_names():
        body = spec.worldbody.add_body(name=name, mocap=True)
        for _ in range(NUM_CAPSULES):
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[0.02] * 3)
    for i in range(NUM_CAPSULES):
        for other in ("ground", "shelf"):
            spec.add_pair(geomname1=other, geomname2=f"capsule_{i}", condim=3, friction=[0.8, 0.8, 0.005, 1e-4, 1e-4])
        for pad in ("left_pad", "right_pad"):
            spec.add_pair(geomname1=pad, geomname2=f"capsule_{i}", condim=4, friction=[1.5, 1.5, 0.01, 1e-4, 1e-4])
    for tip in ("left_tip", "right_tip"):
        spec.add_pair(geomname1=tip, geomname2="shelf", condim=1)
    model = spec.compile()
    model.dof_damping[-3:] = ROLLING
    return model
