"""Jacobians of MJX dynamics against C MuJoCo's finite differences, in float64."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from milx.trajopt.linearize import linearize

T, SUBSTEPS = 6, 5

ARM = """
<mujoco>
  <option timestep="0.01" integrator="{integrator}"><flag constraint="disable" contact="disable"/></option>
  <default><joint axis="0 0 1" armature="1" damping="1"/><geom type="capsule" size="0.02" mass="1"/></default>
  <worldbody>
    <body>
      <joint name="shoulder"/><geom fromto="0 0 0 0.1 0 0"/>
      <body pos="0.1 0 0"><joint name="elbow"/><geom fromto="0 0 0 0.1 0 0"/></body>
    </body>
  </worldbody>
  <actuator><motor joint="shoulder" gear="200"/><motor joint="elbow" gear="200"/></actuator>
</mujoco>
"""
N, M = 4, 2


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def trajectory():
    rng = np.random.default_rng(0)
    return rng.uniform(-2, 2, (T, N)), rng.uniform(-1, 1, (T, M))


def mjx_dynamics(model, substeps):
    model = mjx.put_model(model)
    data = mjx.make_data(model)

    def dynamics(x, u):
        def substep(x, _):
            after = mjx.step(model, data.replace(qpos=x[:2], qvel=x[2:], ctrl=u))
            return jnp.concatenate([after.qpos, after.qvel]), None

        return jax.lax.scan(substep, x, None, substeps)[0]

    return dynamics


def mujoco_step(model, x, u, substeps):
    data = mujoco.MjData(model)
    data.qpos, data.qvel, data.ctrl = x[:2], x[2:], u
    mujoco.mj_step(model, data, substeps)
    return np.concatenate([data.qpos, data.qvel])


@pytest.mark.slow
def test_euler_step_matches_transition_fd(trajectory):
    model = mujoco.MjModel.from_xml_string(ARM.format(integrator="Euler"))
    (A, B), values = jax.jit(lambda x, u: linearize(mjx_dynamics(model, 1), x, u))(*trajectory)
    for t, (x, u) in enumerate(zip(*trajectory, strict=True)):
        data = mujoco.MjData(model)
        data.qpos, data.qvel, data.ctrl = x[:2], x[2:], u
        A_fd, B_fd = np.zeros((N, N)), np.zeros((N, M))
        mujoco.mjd_transitionFD(model, data, 1e-6, True, A_fd, B_fd, None, None)
        # Central differences of 1e-6 leave errors of about 1e-10 of values of order one.
        np.testing.assert_allclose(A[t], A_fd, atol=1e-8)
        np.testing.assert_allclose(B[t], B_fd, atol=1e-8)
        np.testing.assert_allclose(values[t], mujoco_step(model, x, u, 1), atol=1e-12)


@pytest.mark.slow
def test_runge_kutta_substeps_match_differences_of_mujoco(trajectory):
    model = mujoco.MjModel.from_xml_string(ARM.format(integrator="RK4"))
    (A, B), values = jax.jit(lambda x, u: linearize(mjx_dynamics(model, SUBSTEPS), x, u))(*trajectory)
    epsilon = 1e-6
    for t, (x, u) in enumerate(zip(*trajectory, strict=True)):
        z = np.concatenate([x, u])
        step = lambda z: mujoco_step(model, z[:N], z[N:], SUBSTEPS)  # noqa: E731
        fd = np.stack([step(z + e) - step(z - e) for e in epsilon * np.eye(N + M)], axis=1) / (2 * epsilon)
        np.testing.assert_allclose(np.concatenate([A[t], B[t]], axis=1), fd, atol=1e-7)
        np.testing.assert_allclose(values[t], step(z), atol=1e-12)


def test_further_arguments_are_not_differentiated(trajectory):
    # For f = (t x₁ u₀, u₁²) everything is known in closed form.
    states, actions = trajectory

    def function(x, u, t):
        return {"product": t * x[1:2] * u[:1], "square": u[1:] ** 2}

    times = np.arange(T)
    jacobians, values = linearize(function, states, actions, times)
    by_state, by_action = jacobians["product"]
    np.testing.assert_allclose(by_state[:, 0], (times * actions[:, 0])[:, None] * np.eye(N)[1], atol=1e-14)
    np.testing.assert_allclose(by_action[:, 0], (times * states[:, 1])[:, None] * np.eye(M)[0], atol=1e-14)
    np.testing.assert_allclose(values["square"], actions[:, 1:] ** 2, atol=1e-14)
    np.testing.assert_array_equal(jacobians["square"][0], 0)
