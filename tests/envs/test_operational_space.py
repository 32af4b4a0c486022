"""The operational-space law against C MuJoCo's accelerations, in float64."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from milx.envs.operational_space import OperationalSpace

ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="0.002" gravity="0 0 -9.81"><flag contact="disable"/></option>
  <default>
    <geom type="capsule" size="0.03" density="800"/>
    <joint damping="0.4" armature="0.02" stiffness="0.3" springref="0.2"/>
  </default>
  <worldbody>
    <body name="lift"><joint name="lift" type="slide" axis="0 0 1"/><geom fromto="0 0 0 0 0 0.1"/>
      <body><joint name="pan" axis="0 0 1"/><geom fromto="0 0 0 0.3 0 0"/>
        <body pos="0.3 0 0"><joint name="elbow" axis="0 1 0"/><geom fromto="0 0 0 0.3 0 0"/>
          <body pos="0.3 0 0"><joint name="roll" axis="1 0 0"/><geom fromto="0 0 0 0.1 0 0"/>
            <body pos="0.1 0 0"><joint name="wrist" axis="0 1 0"/><geom fromto="0 0 0 0.1 0 0"/>
              <body pos="0.1 0 0"><joint name="yaw" axis="0 0 1"/><geom fromto="0 0 0 0 0.05 0"/>
                <body pos="0 0.05 0"><joint name="last" axis="1 0 0"/><geom fromto="0 0 0 0.05 0 0"/>
                  <site name="tip" pos="0.05 0 0.01"/>
                </body>
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
    <body pos="0 0 2"><freejoint/><geom size="0.05" type="sphere"/></body>
    <site name="fixed"/>
  </worldbody>
  <actuator>
    <general joint="pan" gear="3" biasprm="5 1 1"/>
    <motor joint="lift" gear="20"/>
    <position joint="elbow" kp="30" kv="2"/>
    <velocity joint="roll" kv="5" gear="2"/>
    <motor joint="wrist" gear="-4"/>
    <general joint="yaw" gainprm="2" biasprm="0.3 -1 -0.2" biastype="affine"/>
    <motor joint="last"/>
  </actuator>
</mujoco>
"""
TAU = 0.1


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(ARM)


def moving(model, seed):
    """Returns a state of the arm, and of the body that floats beside it."""
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    data.qpos[:7], data.qvel[:] = rng.uniform(-1, 1, 7), rng.uniform(-1, 1, model.nv)
    data.ctrl[:] = 0
    mujoco.mj_forward(model, data)
    return data


@pytest.fixture(scope="module")
def accelerations(model):
    """Returns the hand's Jacobians [6, nv], and the joints' accelerations [nv] in C MuJoCo, under a law's commands."""
    plant = mjx.put_model(model)

    def under(
        law: OperationalSpace, states: list[mujoco.MjData], wanted: np.ndarray
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        command, found = jax.jit(law.command), []
        for data in states:
            data.ctrl[law.actuators] = command(plant, mjx.put_data(model, data), jnp.asarray(wanted))
            mujoco.mj_forward(model, data)
            jacobian = np.zeros((6, model.nv))
            mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site("tip").id)
            found.append((jacobian, data.qacc))
        return found

    return under


def test_the_joints_accelerate_the_hand_as_the_law_asks(model, accelerations):
    law, wanted = OperationalSpace(model, "tip", time_constant=TAU), np.linspace(-0.5, 0.7, 6)
    states = [moving(model, seed) for seed in range(3)]
    for data, (jacobian, found) in zip(states, accelerations(law, states, wanted), strict=True):
        np.testing.assert_allclose(jacobian @ found, (wanted - jacobian @ data.qvel) / TAU, atol=1e-6)


def test_components_that_are_not_controlled_slow_down_with_the_joints_and_regularization_softens(model, accelerations):
    axes, rho = [0, 1, 2], 0.3
    data, wanted = moving(model, 0), np.array([0.4, -0.2, 0.1])
    ((jacobian, found),) = accelerations(OperationalSpace(model, "tip", axes, TAU, rho), [data], wanted)
    jacobian, speed, inertia = jacobian[axes, :7], data.qvel[:7], np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    inverse = np.linalg.inv(inertia[:7, :7])
    weight = np.linalg.inv(jacobian @ inverse @ jacobian.T + rho * np.eye(3))
    of_hand = inverse @ jacobian.T @ weight @ (wanted - jacobian @ speed) / TAU
    of_rest = (np.eye(7) - inverse @ jacobian.T @ weight @ jacobian) @ -speed / TAU
    np.testing.assert_allclose(found[:7], of_hand + of_rest, atol=1e-6)


@pytest.mark.slow
def test_many_commands_at_once_in_float32_are_those_of_one_in_float64(model):
    law, states = (
        OperationalSpace(model, "tip", (0, 1, 2), TAU, regularization=0.01),
        [moving(model, i) for i in range(4)],
    )
    wanted = np.array([0.4, -0.2, 0.1])

    def commands(dtype):
        cast = lambda tree: jax.tree.map(lambda x: x.astype(dtype) if x.dtype == jnp.float64 else x, tree)  # noqa: E731
        plant = cast(mjx.put_model(model))
        batch = cast(jax.tree.map(lambda *x: jnp.stack(x), *(mjx.put_data(model, state) for state in states)))
        return jax.jit(jax.vmap(law.command, (None, 0, None)))(plant, batch, jnp.asarray(wanted, dtype))

    exact = commands(jnp.float64)
    np.testing.assert_allclose(commands(jnp.float32), exact, atol=1e-4 * np.abs(exact).max())


@pytest.mark.parametrize(
    ("change", "site", "message"),
    [
        (("", ""), "hand", "site: got 'hand', expected one of fixed, tip"),
        (("", ""), "fixed", "site: got one that no joint moves"),
        (('<motor joint="last"/>', ""), "tip", "joint 'last': got 0 actuators, expected one"),
        (('<motor joint="last"/>', '<motor joint="last"/><motor joint="last"/>'), "tip", "got 2 actuators"),
        (
            ('<motor joint="last"/>', '<damper joint="last" ctrlrange="0 1"/>'),
            "tip",
            "joint 'last': expected an actuator with a",
        ),
        (
            ('name="last" axis="1 0 0"', 'name="last" type="ball"'),
            "tip",
            "joint 'last': got mjJNT_BALL, expected a hinge",
        ),
    ],
)
def test_what_the_law_cannot_drive_is_named(change, site, message):
    with pytest.raises(ValueError, match=message):
        OperationalSpace(mujoco.MjModel.from_xml_string(ARM.replace(*change) if change[0] else ARM), site)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"axes": (0, 6)}, r"axes: got \[0, 6\], expected some of 0 to 5, each once"),
        ({"axes": (1, 1)}, r"axes: got \[1, 1\]"),
        ({"axes": ()}, r"axes: got \[\]"),
        ({"time_constant": 0.0}, "time_constant: got 0.0, expected more than 0 s"),
        ({"regularization": -1.0}, "regularization: got -1.0, expected at least 0"),
    ],
)
def test_numbers_out_of_range_are_named(model, arguments, message):
    with pytest.raises(ValueError, match=message):
        OperationalSpace(model, "tip", **arguments)
