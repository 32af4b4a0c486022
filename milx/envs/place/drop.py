"""The fall of a thing into a container, under gravity and with contacts, in a model of its own.

The thing's outline falls: the capsules of its shape, which are what others touch. All things have the same mass and
inertia, so that one program serves them all; where a thing comes to rest hardly depends on either.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.scipy.spatial.transform import Rotation

from milx.core.mjx import mjx
from milx.envs.base import OUT_OF_THE_WAY
from milx.envs.place import containers
from milx.envs.shapes.primitives import NUM_CAPSULES, Geoms

TIMESTEP = 0.004
"""Time step of the simulation (s)."""
SECONDS = 1.0
"""After this time the thing must lie still."""
STILL = 0.05
"""What moves more slowly than this lies still (m/s)."""
ROLLING = 2e-4
"""Damping of the thing's turning (N m s/rad), in place of rolling friction."""
_GRAIN = 1e-3
_XML = f"""
<mujoco>
  <option timestep="{TIMESTEP}" integrator="Euler" iterations="6" ls_iterations="8" jacobian="sparse"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom name="table" type="plane" size="0 0 0.1"/>
    <body name="thing">
      <freejoint/>
      <inertial pos="0 0 0" mass="0.1" diaginertia="4e-5 4e-5 4e-5"/>
    </body>
  </worldbody>
</mujoco>"""


class Fall(NamedTuple):
    """Where the thing is: position and quaternion [7] (m), linear and angular velocity [6] (m/s, rad/s)."""

    qpos: jax.Array
    qvel: jax.Array


class Drop:
    """Lets things fall into containers; pure functions of one world, to be used under `jax.vmap`.

    Attributes:
        mj_model: the model, with geoms of no meaning; `model_of` sets them.
    """

    def __init__(self) -> None:
        self.mj_model = _build()
        device = jax.local_devices()[0]
        self._model = mjx.put_model(self.mj_model, device, impl="jax")
        self._data = mjx.make_data(self._model, device)
        self._capsules = np.array([self.mj_model.geom(f"capsule_{i}").id for i in range(NUM_CAPSULES)])
        self._walls = np.array([self.mj_model.geom(f"wall_{i}").id for i in range(containers.WALLS)])

    def model_of(
        self, thing: Geoms, unit: jax.Array, container: containers.Geoms, width: jax.Array, place: jax.Array
    ) -> mjx.Model:
        """Builds the model with a thing and a container.

        Args:
            thing: its geoms, as it hangs from the hand: below z = 0, which is where it is held.
            unit: its unit of length (m).
            container: its geoms.
            width: half the container's width (m).
            place: [3] where the container stands (m).
        """
        away, model = jnp.array(OUT_OF_THE_WAY), self._model
        capsules, walls = slice(NUM_CAPSULES), slice(containers.WALLS)
        middle = jnp.array([0.0, 0.0, 1.0]) * _middle(thing)
        # A capsule that a shape does not use is a grain within the first one: it falls with the thing.
        used = thing.used[capsules, None]
        held = jnp.where(used, unit * (thing.pos[capsules] - middle), 0.0)
        held_size = jnp.where(used, unit * thing.size[capsules], _GRAIN)
        standing = jnp.where(container.used[walls, None], width * container.pos[walls] + place, away)
        pos = model.geom_pos.at[self._capsules].set(held).at[self._walls].set(standing)
        quat = model.geom_quat.at[self._capsules].set(thing.quat[capsules]).at[self._walls].set(container.quat[walls])
        size = model.geom_size.at[self._capsules].set(held_size)
        return model.replace(
            geom_pos=pos, geom_quat=quat, geom_size=size.at[self._walls].set(width * container.size[walls])
        )

    def start(self, thing: Geoms, unit: jax.Array, tip: jax.Array, turn: jax.Array) -> Fall:
        """Holds the thing at rest at `tip` [3] (m) with axes `turn` [3, 3] (columns)."""
        middle = tip + turn[:, 2] * unit * _middle(thing)
        quat = jnp.roll(Rotation.from_matrix(turn).as_quat(), 1)
        return Fall(jnp.concatenate([middle, quat]), jnp.zeros(6))

    @functools.partial(jax.jit, static_argnums=0)
    def fall(
        self,
        thing: Geoms,
        unit: jax.Array,
        container: containers.Geoms,
        width: jax.Array,
        place: jax.Array,
        tip: jax.Array,
        turn: jax.Array,
    ) -> tuple[Fall, Fall]:
        """Lets the thing fall for SECONDS, and returns its last state and those of all time steps, with a leading axis.

        For the arguments see `model_of` and `start`.
        """
        model = self.model_of(thing, unit, container, width, place)

        def step(fall: Fall, _: None) -> tuple[Fall, Fall]:
            data = mjx.step(model, self._data.replace(qpos=fall.qpos, qvel=fall.qvel))
            return Fall(data.qpos, data.qvel), fall

        return jax.lax.scan(step, self.start(thing, unit, tip, turn), length=round(SECONDS / TIMESTEP))

    def held_at(self, thing: Geoms, unit: jax.Array, fall: Fall) -> tuple[jax.Array, Rotation]:
        """Computes where the thing was held [3] (m) and how it is turned: the inverse of `start`."""
        turn = Rotation.from_quat(jnp.roll(fall.qpos[3:], -1))
        return fall.qpos[:3] - turn.as_matrix()[:, 2] * unit * _middle(thing), turn


def _middle(thing: Geoms) -> jax.Array:
    """Returns the height of the first capsule's axis, where the center of mass is, in the thing's unit of length."""
    return thing.pos[0, 2]


def _build() -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_string(_XML)
    wall, capsule = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE
    for i in range(containers.WALLS):
        spec.worldbody.add_geom(name=f"wall_{i}", type=wall, size=[0.02] * 3)
    for i in range(NUM_CAPSULES):
        spec.body("thing").add_geom(name=f"capsule_{i}", type=capsule, size=[0.02] * 3)
        for other in ("table", *(f"wall_{j}" for j in range(containers.WALLS))):
            spec.add_pair(geomname1=f"capsule_{i}", geomname2=other, condim=3, friction=[0.8, 0.8, 0.005, 1e-4, 1e-4])
    model = spec.compile()
    model.dof_damping[3:] = ROLLING
    return model
