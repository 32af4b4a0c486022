"""Place: a hand holds a thing and puts it into one of three containers (paper, Section 6.3)."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.scipy.spatial.transform import Rotation

from milx.core.linear_algebra import solve_free
from milx.core.mjx import mjx
from milx.envs import shapes
from milx.envs.base import ASSETS, OUT_OF_THE_WAY, Env, State, check_split
from milx.envs.chain import Chain, Pose
from milx.envs.kinematics import kinematics
from milx.envs.layout import first_spaced
from milx.envs.place import containers, drop
from milx.envs.place.containers import CONTAINERS
from milx.envs.place.drop import Fall
from milx.envs.shapes import SHAPES, primitives
from milx.envs.steering import Steering
from milx.render import textures
from milx.render.textures import Textures

NUM_CONTAINERS = 3
NUM_JOINTS = 7
LOW, HIGH = (-0.36, -0.27), (0.0, 0.27)
"""Where containers stand: minimum and maximum x and y of their centers (m)."""
SPACING = 0.2
"""Minimum distance between two containers' centers (m)."""
THING_SIZE = (0.018, 0.026)
"""Unit of length of the held thing's shape (m), drawn uniformly."""
CONTAINER_SIZE = (0.05, 0.065)
"""Half a container's width (m), drawn uniformly."""
MAX_SPEED, MAX_TURN = 0.4, 1.5
"""What an action of 1 asks of the hand: m/s and rad/s."""
CLEARANCE = 0.02
"""Gap between the thing and the rim when the hand opens over a container (m)."""
FALL_FRAMES = 10
"""Images of the fall in a film."""
START_NOISE = 0.12
"""Joints start within this distance of _START (rad)."""
TRACKING = 6.0
"""Rate at which the hand returns to its path, where the planner samples (1/s)."""
OFF_COST, TURN_COST = 5.0, 0.5
"""Weights of the residuals: 1/m, and of unit vectors, which have no unit."""
_START = (0.0, -1.167, 0.0, 1.926, 0.0, 0.811, 0.0)
_DAMPING = 0.05
_CANDIDATES = 64


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PlaceTask:
    """A thing, three containers, and which of them it is to be put into.

    Attributes:
        target: int32, 0 to 2.
        thing: int32, index into SHAPES.
        thing_size: its unit of length (m).
        container: [3] int32, index into CONTAINERS.
        container_size: [3] half their width (m).
        color: [4, 3] RGB in [0, 1] of the thing and of the containers.
        texture: [4] theirs, with frames that take the body's.
    """

    target: jax.Array
    thing: jax.Array
    thing_size: jax.Array
    container: jax.Array
    container_size: jax.Array
    color: jax.Array
    texture: Textures


class Place(Env[PlaceTask]):
    """A seven-joint arm moves its hand by velocities, three containers, 100x90 pixels, 30 actions of 0.1 s.

    The robot's state is 16-dimensional: seven joint angles (rad), the position of the hand's tip (m), and the unit
    vectors in which it points and faces (at the start down, and away from the arm). An action is the hand's linear and
    angular velocity in the world's axes, in [-1, 1] for MAX_SPEED and MAX_TURN; damped least squares (Wampler 1986)
    turn them into velocities of the joints, which stop at their limits. After the last action the hand opens.

    The image covers the middle 200x180 pixels of the paper's view of 320x240, halved: its rays are drawn, no others.
    """

    name = "place"
    horizon = 30
    substeps = 5
    image_shape = (90, 100)
    camera = "front"
    criterion = "the thing comes to rest in or on the target container once the hand has opened"
    state_size = 16
    goal_indices = (7, 8)
    long_chain = False
    ahead = 12
    version = 2

    def __init__(self, image_shape: tuple[int, int] | None = None):
        super().__init__(_build(), image_shape)
        model = self.mj_model
        self._rgba = jnp.asarray(model.geom_rgba, float)
        self._arm, self._hand = Chain(model, "tip"), model.body("hand").id
        self._body = np.array([model.body(name).id for name in ("thing", *_container_names())])
        self._geom = [model.body_geomadr[body] + np.arange(model.body_geomnum[body]) for body in self._body]
        stack = lambda geoms: jax.tree.map(lambda *x: jnp.asarray(np.array(x)), *geoms)  # noqa: E731
        self._things = stack([primitives.to_geoms(shape) for shape in SHAPES.values()])
        self._containers = stack([containers.to_geoms(container) for container in CONTAINERS.values()])
        self._tops = jnp.array([_top(primitives.to_geoms(shape)) for shape in SHAPES.values()])
        self._drop = drop.Drop()

    @property
    def action_size(self) -> int:
        """6: linear and angular velocity."""
        return 6

    @property
    def action_range(self) -> tuple[jax.Array, jax.Array]:
        """-1 and 1, [6] each."""
        return -jnp.ones(6), jnp.ones(6)

    @property
    def image_to_goal(self) -> np.ndarray:
        """The hand ends over the middle of a container."""
        return self.image_to_plane(LOW, HIGH, 0.03)

    def sample_task(self, key: jax.Array, split: str) -> PlaceTask:
        """Draws a thing and three different containers of the split, their sizes and looks, and the target.

        Raises:
            ValueError: for a split that does not exist.
        """
        check_split(split)
        keys = jax.random.split(key, 6)
        indices = lambda names, chosen: jnp.array([list(names).index(name) for name in chosen])  # noqa: E731
        kinds = indices(CONTAINERS, containers.BY_SPLIT[split])
        low, high = CONTAINER_SIZE
        return PlaceTask(
            target=jax.random.randint(keys[0], (), 0, NUM_CONTAINERS),
            thing=jax.random.choice(keys[1], indices(SHAPES, shapes.BY_SPLIT[split])),
            thing_size=jax.random.uniform(keys[2], minval=THING_SIZE[0], maxval=THING_SIZE[1]),
            container=jax.random.choice(keys[3], kinds, (NUM_CONTAINERS,), replace=False),
            container_size=jax.random.uniform(keys[4], (NUM_CONTAINERS,), minval=low, maxval=high),
            **textures.draw_looks(keys[5], split, 1 + NUM_CONTAINERS),
        )

    def redraw_appearance(self, key: jax.Array, task: PlaceTask) -> PlaceTask:
        """Gives the same thing and containers other colors and textures."""
        return dataclasses.replace(task, **textures.draw_looks(key, "train", 1 + NUM_CONTAINERS))

    def reset(self, key: jax.Array, task: PlaceTask) -> State:
        """Holds the thing over the table and stands the containers on it, at least SPACING apart."""
        place_key, joint_key = jax.random.split(key)
        noise = jax.random.uniform(joint_key, (NUM_JOINTS,), minval=-START_NOISE, maxval=START_NOISE)
        place = first_spaced(_draw_places(place_key), SPACING)
        ground = jnp.zeros((NUM_CONTAINERS, 1))
        return State(jnp.array(_START) + noise, jnp.zeros(NUM_JOINTS), jnp.concatenate([place, ground], axis=-1))

    def redraw_scene(self, key: jax.Array, task: PlaceTask, states: State) -> State:
        """Keeps the motion and the target, and moves the two other containers elsewhere."""
        target = states.mocap_pos[0, task.target, :2]
        place = first_spaced(_draw_places(key).at[:, task.target].set(target), SPACING)
        return dataclasses.replace(states, mocap_pos=states.mocap_pos.at[..., :2].set(place))

    @functools.partial(jax.jit, static_argnums=0)
    def hand(self, qpos: jax.Array) -> Pose:
        """Returns the pose of the hand's tip at joints [7]."""
        return self._arm.pose(qpos)

    @property
    def steering(self) -> Steering:
        """The actions [6]; the hand returns to where it is expected, and to how it is turned there.

        It turns back at a rate of TRACKING times the sine of the angle, about the axis between the two.
        """

        def correction(state: State, expected: State) -> jax.Array:
            (tip, axes, _), (goal, wanted, _) = self.hand(state.qpos), self.hand(expected.qpos)
            turn = 0.5 * jnp.cross(axes.T, wanted.T).sum(axis=0)
            return TRACKING * jnp.concatenate([(goal - tip) / MAX_SPEED, turn / MAX_TURN])

        return dataclasses.replace(super().steering, correction=correction)

    def integrate(self, model: mjx.Model, state: State, ctrl: jax.Array) -> jax.Array:
        """Moves the joints for one time step so that the hand moves as `ctrl` asks."""
        return self._move(state.qpos, ctrl, self.mj_model.opt.timestep)

    def approximate_step(self, task: PlaceTask, state: State, action: jax.Array) -> State:
        """Takes one time step as long as the action instead of `substeps`."""
        ctrl, duration = jnp.clip(action, *self.action_range), self.substeps * self.mj_model.opt.timestep
        return state.with_vector(self._move(state.qpos, ctrl, duration))

    def _move(self, qpos: jax.Array, ctrl: jax.Array, h: float) -> jax.Array:
        """Takes an Euler step of `h` seconds and returns the next `state.vector`."""
        _, _, jacobian = self.hand(qpos)
        wanted = ctrl * jnp.array([MAX_SPEED] * 3 + [MAX_TURN] * 3)
        normal = jacobian @ jacobian.T + _DAMPING**2 * jnp.eye(6)
        velocity = jacobian.T @ solve_free(normal, wanted, jnp.ones(6, bool))
        low, high = jnp.asarray(self.mj_model.jnt_range.T, float)
        after = jnp.clip(qpos + h * velocity, low, high)
        return jnp.concatenate([after, (after - qpos) / h])

    @functools.partial(jax.jit, static_argnums=0)
    def model_of(self, task: PlaceTask) -> mjx.Model:
        """Sets the geoms of the task's thing and containers in the model."""
        model = self.model
        pos, quat, size = model.geom_pos, model.geom_quat, model.geom_size
        for geoms, (one, unit) in zip(self._geom, self._geoms_of(task), strict=True):
            pos = pos.at[geoms].set(jnp.where(one.used[:, None], unit * one.pos, jnp.array(OUT_OF_THE_WAY)))
            quat, size = quat.at[geoms].set(one.quat), size.at[geoms].set(unit * one.size)
        return model.replace(geom_pos=pos, geom_quat=quat, geom_size=size)

    def _geoms_of(self, task: PlaceTask) -> list[tuple[Any, jax.Array]]:
        """Returns the geoms of the thing, which hangs from the tip, and of the containers, each with its unit (m)."""
        thing = jax.tree.map(lambda x: x[task.thing], self._things)
        thing = thing._replace(pos=thing.pos.at[:, 2].add(-self._tops[task.thing]))
        picked = [jax.tree.map(lambda x, i=i: x[task.container[i]], self._containers) for i in range(NUM_CONTAINERS)]
        return [(thing, task.thing_size), *zip(picked, task.container_size, strict=True)]

    def robot_state(self, state: State) -> jax.Array:
        """Returns [16] joint angles, tip position, and the directions in which the hand points and faces."""
        tip, axes, _ = self.hand(state.qpos)
        return jnp.concatenate([state.qpos, tip, axes[:, 0], axes[:, 2]])

    def colors(self, task: PlaceTask) -> jax.Array:
        """Returns [G, 4] RGBA of every geom; what a thing or container does not use is transparent."""
        rgba = self._rgba
        for geoms, color, (one, _) in zip(self._geom, task.color, self._geoms_of(task), strict=True):
            seen = one.seen if isinstance(one, primitives.Geoms) else one.used
            rgba = rgba.at[geoms].set(jnp.column_stack([jnp.broadcast_to(color, (len(geoms), 3)), seen]))
        return rgba

    def textures(self, task: PlaceTask, data: mjx.Data) -> Textures:
        """Returns the textures [G] of the thing and the containers; all else is plain."""
        return textures.on_geoms(task.texture, self._body, self.mj_model.geom_bodyid, data.xpos, data.xmat)

    def target_kind(self, task: PlaceTask) -> jax.Array:
        """Returns the target's index into CONTAINERS."""
        return task.container[task.target]

    def release_height(self, task: PlaceTask) -> jax.Array:
        """Returns the height of the tip (m) at which the thing hangs CLEARANCE above the target's rim."""
        rim = task.container_size[task.target] * self._containers.height[task.container[task.target]]
        return rim + task.thing_size * self._tops[task.thing] + CLEARANCE

    def running_residual(self, task: PlaceTask, state: State, action: jax.Array, t: jax.Array) -> jax.Array:
        """Returns [15]: the tip's distance from over the target (m), the hand's tilt and turn, and action, weighted."""
        return jnp.concatenate([self.terminal_residual(task, state), self.action_cost * action])

    def terminal_residual(self, task: PlaceTask, state: State) -> jax.Array:
        """Returns [9]: the same without the action."""
        tip, axes, _ = self.hand(state.qpos)
        goal = state.mocap_pos[task.target].at[2].set(self.release_height(task))
        upright = jnp.concatenate([axes[:, 0] + jnp.array([0.0, 0.0, 1.0]), axes[:, 2] - jnp.array([1.0, 0.0, 0.0])])
        return jnp.concatenate([OFF_COST * (tip - goal), TURN_COST * upright])

    def falls(self, task: PlaceTask, state: State) -> tuple[Fall, Fall]:
        """Lets the thing fall when the hand opens: its last state, and those on its way (`milx.envs.place.drop`).

        It can hit the container whose middle is closest under the hand, and the table.
        """
        tip, axes, _ = self.hand(state.qpos)
        # The thing's axes: x faces forward, z is up where the hand points down.
        turn = jnp.stack([axes[:, 2], axes[:, 1], -axes[:, 0]], axis=1)
        under = jnp.argmin(jnp.linalg.norm(state.mocap_pos[:, :2] - tip[:2], axis=-1))
        thing, *_ = self._geoms_of(task)
        container = jax.tree.map(lambda x: x[task.container[under]], self._containers)
        return self._drop.fall(*thing, container, task.container_size[under], state.mocap_pos[under], tip, turn)

    def film(self, task: PlaceTask, states: State) -> jax.Array:
        """Draws images [T + 1 + FALL_FRAMES, H, W, 3] uint8 of an episode and of the fall that follows it."""
        last, model = jax.tree.map(lambda x: x[-1], states), self.model_of(task)
        thing, *_ = self._geoms_of(task)
        data = kinematics(model, self.data(last))
        hand = Rotation.from_matrix(data.xmat[self._hand])

        def draw(fall: Fall) -> jax.Array:
            place, turn = self._drop.held_at(*thing, fall)
            pos = hand.inv().apply(place - data.xpos[self._hand])
            quat = jnp.roll((hand.inv() * turn).as_quat(), 1)
            body = self._body[0]
            moved = model.replace(
                body_pos=model.body_pos.at[body].set(pos), body_quat=model.body_quat.at[body].set(quat)
            )
            return self._draw(moved, task, last)

        _, way = self.falls(task, last)
        shown = jax.tree.map(lambda x: x[np.linspace(0, len(x) - 1, FALL_FRAMES).astype(int)], way)
        return jnp.concatenate([super().film(task, states), jax.vmap(draw)(shown)])

    def success(self, task: PlaceTask, states: State) -> jax.Array:
        """Tells whether the thing rests within the target's rim, seen from above."""
        last = jax.tree.map(lambda x: x[-1], states)
        end, _ = self.falls(task, last)
        rim = jax.tree.map(lambda x: x[task.container[task.target]], self._containers)
        off = (end.qpos[:2] - last.mocap_pos[task.target, :2]) / (task.container_size[task.target] * rim.half)
        inside = jnp.where(rim.round, jnp.linalg.norm(off), jnp.abs(off).max()) < 1
        return inside & (jnp.linalg.norm(end.qvel[:3]) < drop.STILL)

    def task_blind(self, key: jax.Array, task: PlaceTask) -> PlaceTask:
        """Makes a random container the target."""
        return dataclasses.replace(task, target=jax.random.randint(key, (), 0, NUM_CONTAINERS))


def _container_names() -> list[str]:
    return [f"container_{i}" for i in range(NUM_CONTAINERS)]


def _top(geoms: primitives.Geoms) -> float:
    """Computes the height of a shape above the table, in its unit of length."""
    column = np.repeat(
        [{"capsule": 0, "cylinder": 1}.get(kind, 2) for kind in primitives.SLOTS], [*primitives.SLOTS.values()]
    )
    tops = geoms.pos[:, 2] + geoms.size[np.arange(len(column)), column]
    return float(tops[geoms.seen].max())


def _draw_places(key: jax.Array) -> jax.Array:
    """Samples [_CANDIDATES, 3, 2] positions on the table (m)."""
    shape = (_CANDIDATES, NUM_CONTAINERS, 2)
    return jax.random.uniform(key, shape, minval=jnp.array(LOW), maxval=jnp.array(HIGH))


def _build() -> mujoco.MjModel:
    """Builds the arm and the table, with a thing in the hand and containers whose geoms every task sets anew."""
    spec = mujoco.MjSpec.from_file(str(ASSETS / "place.xml"))
    tip = spec.site("tip")
    facing = [0.5**0.5, 0.0, -(0.5**0.5), 0.0]  # its x along the hand's z, its z against the hand's x
    bodies = [spec.body("hand").add_body(name="thing", pos=tip.pos, quat=facing)]
    bodies += [spec.worldbody.add_body(name=name, mocap=True) for name in _container_names()]
    for body, slots in zip(bodies, [primitives.SLOTS, *[containers.SLOTS] * NUM_CONTAINERS], strict=True):
        for kind, count in slots.items():
            for _ in range(count):
                body.add_geom(type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}"), size=[0.02] * 3)
    return spec.compile()
