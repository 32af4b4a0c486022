"""The kinematics of a chain of hinges against C MuJoCo."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from milx.envs.chain import Chain

JOINTS = 5


def build(joint=mujoco.mjtJoint.mjJNT_HINGE):
    """Builds a chain whose bodies are turned and whose hinges are inclined at random; its last joint is `joint`."""
    rng = np.random.default_rng(0)
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for i in range(JOINTS):
        quat, axis = (x / np.linalg.norm(x) for x in (rng.normal(size=4), rng.normal(size=3)))
        body = body.add_body(name=f"link_{i}", pos=rng.normal(size=3), quat=quat)
        body.add_joint(type=joint if i == JOINTS - 1 else mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
    body.add_site(name="end", pos=rng.normal(size=3))
    return spec.compile()


def test_pose_and_jacobian_are_those_of_mujoco():
    model = build()
    data, jacobian, site = mujoco.MjData(model), np.zeros((6, JOINTS)), model.site("end").id
    with jax.enable_x64(True):
        pose = jax.jit(Chain(model, "end").pose)
        for angles in np.random.default_rng(1).uniform(-4, 4, (10, JOINTS)):
            data.qpos[:] = angles
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
            found = pose(jnp.asarray(angles))
            np.testing.assert_allclose(found.position, data.site_xpos[site], rtol=0, atol=1e-12)
            np.testing.assert_allclose(found.axes, data.xmat[-1].reshape(3, 3), rtol=0, atol=1e-12)
            np.testing.assert_allclose(found.jacobian, jacobian, rtol=0, atol=1e-12)


def test_a_chain_has_hinges_only():
    with pytest.raises(ValueError, match="body 'link_4': got other joints, expected one hinge at its origin"):
        Chain(build(mujoco.mjtJoint.mjJNT_SLIDE), "end")
