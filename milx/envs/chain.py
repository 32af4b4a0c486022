"""Kinematics of a serial chain of hinges: from its angles to its end's pose and Jacobian.

With joint j at p_j, turning body j about the axis a_j (a unit vector in its own frame) by q_j,

    p_j = p_{j-1} + R_{j-1} d_j        R_j = R_{j-1} D_j exp(q_j [a_j]_x)        x = p_n + R_n s,

where d_j and D_j are the position and orientation of body j in body j - 1, [a]_x is the matrix of the cross product
with a, exp is Rodrigues' formula, and s is the position of the end in the last body. The columns of the Jacobian are

    (R_j a_j x (x - p_j), R_j a_j).

MJX computes the same for any model, in a larger program that visits all bodies and geoms. A planner compiles several
copies of it with derivatives.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

_product = functools.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)  # a GPU rounds more by default


class Pose(NamedTuple):
    """Where the end of a chain is, and how its n joints move it.

    Attributes:
        position: [3] of the end (m).
        axes: [3, 3], the axes of the last body as columns.
        jacobian: [6, n], from the joints' velocities (rad/s) to the end's velocity (m/s) and the last body's angular
            velocity (rad/s), in the world's axes.
    """

    position: jax.Array
    axes: jax.Array
    jacobian: jax.Array


class Chain:
    """The chain from the world to a site.

    Args:
        model: MuJoCo's model.
        site: the site's name. Every body from the world to it has one hinge, at its origin.

    Raises:
        ValueError: for a body with other joints.
    """

    def __init__(self, model: mujoco.MjModel, site: str):
        self._end = model.site(site).pos.copy()
        bodies: list[int] = []
        body = int(model.site(site).bodyid[0])
        while body:
            joint = model.body_jntadr[body]
            hinge = model.body_jntnum[body] == 1 and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
            if not hinge or model.jnt_pos[joint].any():
                raise ValueError(f"body {model.body(body).name!r}: got other joints, expected one hinge at its origin")
            bodies.insert(0, body)
            body = int(model.body_parentid[body])
        self._axis = model.jnt_axis[model.body_jntadr[bodies]]
        self._offset = model.body_pos[bodies]
        turn = np.zeros((len(bodies), 9))
        for matrix, quat in zip(turn, model.body_quat[bodies], strict=True):
            mujoco.mju_quat2Mat(matrix, quat)
        self._turn = turn.reshape(-1, 3, 3)

    def pose(self, angles: jax.Array) -> Pose:
        """Computes the pose of the end at joint angles [n] (rad)."""
        axis, offset, turn, end = (
            jnp.asarray(x, angles.dtype) for x in (self._axis, self._offset, self._turn, self._end)
        )
        eye = jnp.eye(3, dtype=angles.dtype)
        cross = jnp.cross(axis[:, None], eye).swapaxes(1, 2)
        cos, sin = jnp.cos(angles)[:, None, None], jnp.sin(angles)[:, None, None]
        rotation = _product(turn, cos * eye + sin * cross + (1 - cos) * axis[:, :, None] * axis[:, None])

        def link(frame: tuple, body: tuple) -> tuple[tuple, tuple]:
            position, axes = frame
            position, axes = position + _product(axes, body[0]), _product(axes, body[1])
            return (position, axes), (position, axes)

        (position, axes), (joint, frames) = jax.lax.scan(
            link, (jnp.zeros_like(end), eye), (offset, rotation), unroll=True
        )
        position = position + _product(axes, end)
        turned = _product(frames, axis[..., None])[..., 0]
        lever = jnp.cross(turned, position - joint)
        return Pose(position, axes, jnp.concatenate([lever, turned], axis=1).T)
