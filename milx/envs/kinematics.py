"""Forward kinematics of any model by products of matrices, for programs that mainly compute pixels.

With the homogeneous matrices T_b of body b in its parent p, J_1 ... J_k of its joints' motions, and W_b in the world,

    W_b = W_p T_b J_1 ... J_k,

where a hinge at p about the unit axis a turns by exp((q - q0) [a]_x) (Rodrigues' formula) about p, a slide moves by
(q - q0) a, and a ball turns about p by its quaternion. The pose of a body with a free joint is its coordinates, and
that of a mocap body is given.

`mjx.kinematics` computes the same with quaternions, in elementwise operations. Compilers that fuse those into every
geom of a long chain compute the chain again for each; they do not do so with products of matrices.
"""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.scipy.spatial.transform import Rotation

from milx.core.mjx import mjx

_KINDS = mujoco.mjtJoint
_product = functools.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)  # a GPU rounds more by default


def _matrix(position: jax.Array, rotation: jax.Array) -> jax.Array:
    """Makes homogeneous matrices [..., 4, 4] of positions [..., 3] and rotations [..., 3, 3]."""
    top = jnp.concatenate([rotation, position[..., None]], axis=-1)
    return jnp.concatenate([top, jnp.broadcast_to(jnp.eye(4, dtype=top.dtype)[3:], (*top.shape[:-2], 1, 4))], axis=-2)


def _rotation(quat: jax.Array) -> jax.Array:
    """Turns quaternions [..., 4], real part first and of any length, into rotations [..., 3, 3]."""
    return Rotation.from_quat(jnp.roll(quat, -1, axis=-1)).as_matrix()


def _about(anchor: jax.Array, rotation: jax.Array) -> jax.Array:
    """Makes homogeneous matrices that rotate about an anchor [..., 3]."""
    return _matrix(anchor - _product(rotation, anchor[..., None])[..., 0], rotation)


def _motions(model: mjx.Model, qpos: jax.Array) -> dict[int, jax.Array]:
    """Computes the homogeneous matrix of each joint's motion, by the joint; a free joint's is the body's pose."""
    kinds, start = model.jnt_type, model.jnt_qposadr
    motions: dict[int, jax.Array] = {}
    turning = np.flatnonzero(np.isin(kinds, (_KINDS.mjJNT_HINGE, _KINDS.mjJNT_SLIDE)))
    if turning.size:
        moved = qpos[start[turning]] - model.qpos0[start[turning]]
        axis = model.jnt_axis[turning]
        slides = jnp.asarray(kinds[turning] == _KINDS.mjJNT_SLIDE)[:, None]
        hinge = _about(model.jnt_pos[turning], Rotation.from_rotvec(moved[:, None] * axis).as_matrix())
        slide = _matrix(moved[:, None] * axis, jnp.broadcast_to(jnp.eye(3, dtype=qpos.dtype), hinge[:, :3, :3].shape))
        motions |= dict(zip(turning.tolist(), jnp.where(slides[..., None], slide, hinge), strict=True))
    for joint in np.flatnonzero(kinds == _KINDS.mjJNT_BALL).tolist():
        quat = qpos[start[joint] : start[joint] + 4]
        motions[joint] = _about(model.jnt_pos[joint], _rotation(quat))
    for joint in np.flatnonzero(kinds == _KINDS.mjJNT_FREE).tolist():
        first = start[joint]
        motions[joint] = _matrix(qpos[first : first + 3], _rotation(qpos[first + 3 : first + 7]))
    return motions


def kinematics(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Computes where bodies and geoms are, and what cameras need to know of bodies.

    Args:
        model: of which bodies' poses, joints' places, and geoms' poses may be traced.
        data: `qpos`, `mocap_pos` and `mocap_quat` are read.

    Returns:
        The data with `xpos`, `xquat`, `xmat`, `xipos`, `geom_xpos` and `geom_xmat` (m, in the world's axes). Unlike
        `mjx.kinematics`, it does not set `qpos`, `ximat`, and the poses of joints and sites.
    """
    motions = _motions(model, data.qpos)
    local = _matrix(model.body_pos, _rotation(model.body_quat))
    mocap = _matrix(data.mocap_pos, _rotation(data.mocap_quat)) if model.nmocap else local
    world = [jnp.eye(4, dtype=data.qpos.dtype)]
    for body in range(1, model.nbody):
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        joints = range(first, first + count)
        if model.body_mocapid[body] >= 0:
            pose = mocap[model.body_mocapid[body]]
        elif count and model.jnt_type[first] == _KINDS.mjJNT_FREE:
            pose = motions[first]
        else:
            pose = _product(world[model.body_parentid[body]], local[body])
            for joint in joints:
                pose = _product(pose, motions[joint])
        world.append(pose)
    frames = jnp.stack(world)
    xpos, xmat = frames[:, :3, 3], frames[:, :3, :3]
    quat = jnp.roll(Rotation.from_matrix(xmat).as_quat(), 1, axis=-1)
    geoms = _product(frames[model.geom_bodyid], _matrix(model.geom_pos, _rotation(model.geom_quat)))
    inertia = xpos + _product(xmat, model.body_ipos[..., None])[..., 0]
    return data.replace(
        xpos=xpos, xquat=quat, xmat=xmat, xipos=inertia, geom_xpos=geoms[:, :3, 3], geom_xmat=geoms[:, :3, :3]
    )
