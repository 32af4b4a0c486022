"""Forward kinematics by products of matrices against C MuJoCo, and the training programs that rest on it."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from milx.core.mjx import mjx
from milx.envs.kinematics import kinematics

KINDS = mujoco.mjtJoint


def build():
    """Builds a tree with joints of all kinds, two of them on one body, and a mocap body that carries another body."""
    rng = np.random.default_rng(0)
    spec = mujoco.MjSpec()

    def add(parent, *joints, **fields):
        body = parent.add_body(pos=rng.normal(size=3), quat=rng.normal(size=4), **fields)
        for kind in joints:
            axis = rng.normal(size=3)
            body.add_joint(type=kind, pos=rng.normal(size=3), axis=axis / np.linalg.norm(axis), ref=rng.normal())
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=rng.uniform(0.1, 1, 3), pos=rng.normal(size=3), quat=rng.normal(size=4)
        )
        return body

    arm = add(add(spec.worldbody, KINDS.mjJNT_HINGE), KINDS.mjJNT_SLIDE, KINDS.mjJNT_HINGE)
    add(add(arm), KINDS.mjJNT_BALL)
    add(add(spec.worldbody), KINDS.mjJNT_HINGE)
    free = spec.worldbody.add_body()
    free.add_freejoint()
    free.add_geom(size=[0.1, 0, 0], pos=rng.normal(size=3))
    add(free, KINDS.mjJNT_SLIDE)
    add(add(spec.worldbody, mocap=True))
    return spec.compile()


def test_poses_are_those_of_mujoco():
    model, rng = build(), np.random.default_rng(1)
    data = mujoco.MjData(model)
    with jax.enable_x64(True):
        device_model = mjx.put_model(model)
        device_data = mjx.make_data(device_model)
        poses = jax.jit(lambda values: kinematics(device_model, device_data.replace(**values)))
        for _ in range(5):
            data.qpos[:] = rng.normal(size=model.nq)
            data.mocap_pos[:], data.mocap_quat[:] = rng.normal(size=(1, 3)), rng.normal(size=(1, 4))
            found = poses({name: jnp.asarray(getattr(data, name)) for name in ("qpos", "mocap_pos", "mocap_quat")})
            mujoco.mj_kinematics(model, data)
            for name in ("xpos", "xipos", "xmat", "geom_xpos", "geom_xmat"):
                expected = getattr(data, name)
                actual = getattr(found, name).reshape(expected.shape)
                np.testing.assert_allclose(actual, expected, rtol=0, atol=1e-12, err_msg=name)
            # A quaternion and its negative are the same rotation.
            same = np.abs(np.sum(found.xquat * data.xquat, axis=1))
            np.testing.assert_allclose(same, 1.0, rtol=0, atol=1e-12)
