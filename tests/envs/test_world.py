"""What an environment need not write, because its model tells it."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from milx.envs.base import Env, State

MJCF = """
<mujoco>
  <worldbody>
    <camera name="above" pos="0 0 1"/>
    <body pos="0 0 0.3"><freejoint/><geom size="0.05" rgba="0.1 0.2 0.3 0.4"/></body>
    <body>
      <joint name="passive" type="slide" axis="1 0 0"/><geom size="0.05"/>
      <body pos="0 0 1">
        <joint name="shoulder" axis="0 0 1"/><geom size="0.05"/>
        <body pos="1 0 0"><joint name="elbow" axis="0 0 1"/><geom size="0.05"/></body>
      </body>
    </body>
    <body mocap="true"><geom size="0.05"/></body>
  </worldbody>
  <actuator>
    <motor joint="elbow" ctrlrange="-2 2"/>
    <motor joint="shoulder" ctrlrange="-1 3"/>
  </actuator>
</mujoco>
"""


class Arm(Env):
    name, criterion, horizon, substeps, image_shape, camera = "arm", "", 7, 1, (8, 10), "above"

    def sample_task(self, key, split):
        return jax.random.normal(key, (2,))

    def reset(self, key, task):
        return State(jnp.asarray(self.mj_model.qpos0, float), jnp.zeros(9), jnp.zeros((1, 3)))

    def running_residual(self, task, state, action, t):
        return jnp.concatenate([state.qpos[8:] - task, 5 * action, jnp.array([t])])

    def success(self, task, states):
        return jnp.array(True)

    def task_blind(self, key, task):
        return task


@pytest.fixture(scope="module")
def env():
    return Arm(mujoco.MjModel.from_xml_string(MJCF))


@pytest.fixture(scope="module")
def state():
    return State(jnp.arange(10.0), 100 + jnp.arange(9.0), jnp.zeros((1, 3)))


def test_an_actuator_without_a_range_is_refused():
    unlimited = MJCF.replace("<actuator>", '<actuator><motor name="lift" joint="passive"/>')
    env = Arm(mujoco.MjModel.from_xml_string(unlimited))
    with pytest.raises(ValueError, match=r"ctrlrange: got none for actuator 0 \(lift\), expected the lowest"):
        env.action_range  # noqa: B018


def test_an_actuator_whose_joint_the_default_state_cannot_show_is_refused(state):
    jointed = MJCF.replace("<actuator>", '<actuator><motor jointinparent="elbow" ctrlrange="-1 1"/>')
    env = Arm(mujoco.MjModel.from_xml_string(jointed))
    with pytest.raises(ValueError, match=r"actuator 0 \(without a name\): got no joint .*expected a hinge or a slide"):
        env.robot_state(state)


def test_the_robot_knows_the_joints_that_it_can_move(env, state):
    """qpos holds the free body's 7, the passive joint, shoulder and elbow; qvel holds 6 of the free body."""
    np.testing.assert_array_equal(env.robot_state(state), [8, 9, 107, 108])
    assert env.state_size == env.spec.state_size == 4


def test_costs_at_the_end_are_the_running_ones_without_an_action(env, state):
    task = jnp.array([1.0, -1.0])
    np.testing.assert_array_equal(env.terminal_residual(task, state), [7, 10, 0, 0, 7])


def test_looks_are_those_of_the_model_and_nothing_is_redrawn(env, state):
    key, task = jax.random.key(0), jnp.array([1.0, -1.0])
    np.testing.assert_allclose(env.colors(task), env.mj_model.geom_rgba)
    np.testing.assert_allclose(env.colors(task)[0], [0.1, 0.2, 0.3, 0.4], rtol=1e-6)
    np.testing.assert_array_equal(env.redraw_appearance(key, task), task)
    states = jax.tree.map(lambda x: jnp.stack([x, 2 * x]), state)
    jax.tree.map(np.testing.assert_array_equal, env.redraw_scene(key, task, states), states)


def test_planners_by_sampling_choose_the_actions(env, state):
    steering = env.steering
    for controls, action in ((steering.low, [-2, -1]), (steering.high, [2, 3]), (jnp.array([0.5, 0.0]), [1, 1])):
        np.testing.assert_allclose(steering.action(state, controls), action)
    np.testing.assert_array_equal(steering.correction(state, env.reset(None, None)), jnp.zeros(2))
    np.testing.assert_allclose(steering.deviation, 0.3, rtol=1e-6)


@pytest.mark.parametrize("warp", [False, True])
@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_only_warp_on_a_gpu_captures_graphs(env, warp, backend, monkeypatch):
    monkeypatch.setattr(env, "_warp", object() if warp else None)
    monkeypatch.setattr(jax, "default_backend", lambda: backend)
    assert env.captures_graphs is (warp and backend == "gpu")
