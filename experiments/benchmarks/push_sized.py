"""A world of the size of the paper's push experiment, for measuring speed: nothing is learned in it.

Seven torque-controlled joints, an object and a distractor of five primitives each that slide and turn in the plane, 24
geoms, 125x125 pixels, 100 steps.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from milx.config.schema import Config, DataConfig, EnvConfig, TrainConfig
from milx.envs.base import Env, State
from milx.methods.mil import MILConfig
from milx.networks.policy_network import PolicyConfig

_JOINTS = ("0 0 1", "0 1 0", "0 0 1", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
_THING = """
<body name="{name}" pos="{x} {y} 0.05">
  <joint name="{name}_x" type="slide" axis="1 0 0" damping="1"/>
  <joint name="{name}_y" type="slide" axis="0 1 0" damping="1"/>
  <joint name="{name}_turn" type="hinge" axis="0 0 1" damping="0.02"/>
  <geom name="{name}" type="capsule" fromto="-0.03 0 0 0.03 0 0" size="0.03" density="300"/>
  <geom type="ellipsoid" pos="0 0.03 0.01" size="0.03 0.02 0.03"/>
  <geom type="box" pos="0.04 0 0.02" size="0.02 0.02 0.02"/>
  <geom type="cylinder" pos="-0.04 0 0.02" size="0.015 0.03"/>
  <geom type="sphere" pos="0 0 0.045" size="0.02"/>
</body>"""


def _arm() -> str:
    """Writes seven links inside each other, with a fork of three capsules at the end."""
    inner = (
        '<geom name="palm" class="link" fromto="0 -0.04 0.1 0 0.04 0.1" size="0.015"/>'
        '<geom name="left" class="link" fromto="0 0.04 0.1 0 0.04 0.15" size="0.012"/>'
        '<geom name="right" class="link" fromto="0 -0.04 0.1 0 -0.04 0.15" size="0.012"/>'
        '<site name="effector" pos="0 0 0.15"/>'
    )
    for i, axis in reversed(list(enumerate(_JOINTS))):
        inner = (
            f'<body name="link{i}" pos="0 0 {0.05 if i == 0 else 0.1}"><joint name="joint{i}" axis="{axis}"/>'
            f'<geom class="link" fromto="0 0 0 0 0 0.1" size="{0.035 - 0.003 * i:.3f}"/>{inner}</body>'
        )
    return f'<body name="base" pos="-0.55 0 0.05">{inner}</body>'


XML = f"""
<mujoco model="push_sized">
  <compiler angle="radian" inertiafromgeom="true" autolimits="true"/>
  <option timestep="0.01" gravity="0 0 0" integrator="Euler" iterations="4" ls_iterations="6" jacobian="sparse"/>
  <default>
    <geom contype="0" conaffinity="0" rgba="0.6 0.6 0.65 1"/>
    <joint type="hinge" damping="1" armature="0.1"/>
    <motor ctrlrange="-1 1" gear="2"/>
    <default class="link"><geom type="capsule" density="300" rgba="0.3 0.3 0.35 1"/></default>
  </default>
  <worldbody>
    <light directional="true" pos="0 0 3" dir="-0.3 0.2 -1" diffuse="0.5 0.5 0.5" specular="0.2 0.2 0.2"/>
    <camera name="camera" pos="0.9 0 0.9" xyaxes="0 1 0 -0.65 0 0.75" fovy="45"/>
    <geom name="floor" type="plane" size="0 0 0.1" rgba="0.4 0.45 0.5 1"/>
    <geom name="table" type="box" pos="0 0 0.01" size="0.45 0.4 0.01" rgba="0.7 0.6 0.5 1"/>
    <geom name="goal" type="cylinder" pos="0.1 0 0.021" size="0.08 0.001" rgba="0.9 0.1 0.1 1"/>
    <geom name="stand" type="cylinder" pos="-0.55 0 0.05" size="0.06 0.05"/>
    {_arm()}
    {_THING.format(name="object", x=-0.15, y=0.1)}
    {_THING.format(name="distractor", x=-0.15, y=-0.1)}
  </worldbody>
  <contact>
    <pair geom1="palm" geom2="object" condim="1"/>
    <pair geom1="left" geom2="object" condim="1"/>
    <pair geom1="right" geom2="object" condim="1"/>
    <pair geom1="left" geom2="distractor" condim="1"/>
    <pair geom1="right" geom2="distractor" condim="1"/>
  </contact>
  <actuator>{"".join(f'<motor joint="joint{i}"/>' for i in range(len(_JOINTS)))}</actuator>
</mujoco>"""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Looks:
    """The task: [G, 3] colors."""

    color: jax.Array


class PushSized(Env):
    """Seven joints, two things that can be pushed, 24 geoms."""

    name = "push_sized"
    horizon = 100
    substeps = 5
    image_shape = (125, 125)
    camera = "camera"
    criterion = "none: for measuring speed"
    state_size = 20
    goal_indices = (14, 15)

    def __init__(self, image_shape: tuple[int, int] | None = None):
        super().__init__(mujoco.MjModel.from_xml_string(XML), image_shape)
        self._effector = self.mj_model.site("effector").id

    def sample_task(self, key: jax.Array, split: str) -> Looks:
        """Samples colors."""
        return Looks(jax.random.uniform(key, (self.mj_model.ngeom, 3)))

    def redraw_appearance(self, key: jax.Array, task: Looks) -> Looks:
        """Samples other colors."""
        return self.sample_task(key, "train")

    def redraw_scene(self, key: jax.Array, task: Looks, states: State) -> State:
        """Returns the same states: there is nothing else to place."""
        return states

    def reset(self, key: jax.Array, task: Looks) -> State:
        """Bends the arm and moves it at random; puts the objects where they belong."""
        bent = jnp.array([0.0, 0.6, 0.0, 1.0, 0.0, 0.9, 0.0, *jnp.zeros(6)])
        qpos = bent + jax.random.uniform(key, bent.shape, minval=-0.1, maxval=0.1)
        return State(qpos, jnp.zeros(self.mj_model.nv), jnp.zeros((0, 3)))

    def robot_state(self, state: State) -> jax.Array:
        """Returns [20] joint angles and velocities, position of the effector, and two axes' first columns."""
        data = mjx.kinematics(self.model, self.data(state))
        pose = [data.site_xpos[self._effector], data.site_xmat[self._effector].reshape(-1)[:3]]
        return jnp.concatenate([state.qpos[:7], state.qvel[:7], *pose])

    def colors(self, task: Looks) -> jax.Array:
        """Returns [G, 4] RGBA of every geom."""
        return jnp.concatenate([task.color, jnp.ones((len(task.color), 1))], axis=1)

    def running_residual(self, task: Looks, state: State, action: jax.Array, t: jax.Array) -> jax.Array:
        """Returns [7], the action."""
        return action

    def terminal_residual(self, task: Looks, state: State) -> jax.Array:
        """Returns [2], the object's displacement."""
        return state.qpos[7:9]

    def success(self, task: Looks, states: State) -> jax.Array:
        """Returns true."""
        return jnp.bool_(True)

    def task_blind(self, key: jax.Array, task: Looks) -> Looks:
        """Returns the same task."""
        return task


def config(**train: Any) -> Config:
    """Returns the paper's hyperparameters for push: four 5x5 convolutions of 16 filters, 15 tasks, two heads."""
    return Config(
        env_name="push_sized",
        method_name="mil",
        preset="paper",
        env=EnvConfig(image_shape=PushSized.image_shape),
        data=DataConfig(tasks=64, demos_per_task=4),
        network=PolicyConfig(
            filters=(16,) * 4,
            strides=(2,) * 4,
            kernel=5,
            soft_argmax=True,
            fc_layers=(200,) * 3,
            bias_transformation=20,
            heads=2,
        ),
        method=MILConfig(inner_lr=0.01, inner_clip=10.0, loss_scale=50.0),
        train=TrainConfig(**{"meta_batch": 15, **train}),
    )
