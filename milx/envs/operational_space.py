"""Operational space: a hand's velocity as the control, for planners that need not know how a robot is driven.

A site of the model, on an arm of n joints, moves with the velocity v = J q̇, of which k components (of three linear and
three angular ones) are controlled. The law asks for accelerations of the hand, but for J̇ q̇, and of the joints,

    a = (v* - v) / τ        q̈_0 = -q̇ / τ,

and computes the torques of the joints from the arm's inertia M and bias h (gravity, Coriolis and centrifugal forces,
less those of springs and dampers):

    Λ = (J M⁻¹ Jᵀ + ρ I)⁻¹        N = I - Jᵀ Λ J M⁻¹
    torque = Jᵀ Λ a + N M q̈_0 + h.

For ρ = 0 the joints' accelerations q̈ then satisfy J q̈ = a, whatever q̈_0 is, unless a limit, a constraint, friction or
contact stands in the way (Khatib 1987, with the dynamically consistent inverse M⁻¹ Jᵀ Λ; he compensates J̇ q̇, too, which
is small at a hand's speeds). ρ bounds the torques near singular poses, where J M⁻¹ Jᵀ has no inverse. Joints beyond the
hand, such as fingers, count in M as locked, and have commands of their own. The actuator of joint j exerts
gear_j (g_j u_j + b_j0 + b_j1 l_j + b_j2 l̇_j) at length l_j = gear_j q_j, so that the command is

    u_j = (torque_j / gear_j - b_j0 - b_j1 l_j - b_j2 l̇_j) / g_j.

Reference:
    Khatib, "A unified approach for motion and force control of robot manipulators: the operational space formulation",
        IEEE Journal of Robotics and Automation 3(1), 1987.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from milx.core.linear_algebra import solve_free
from milx.core.mjx import mjx

_KINDS = mujoco.mjtJoint
_product = functools.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)  # a GPU rounds more by default


class OperationalSpace:
    """The law for one site of a model.

    Args:
        model: the robot; `command` may be given one with other masses, sizes and dampings.
        site: the hand's name.
        axes: which components of the hand's velocity are controlled: 0 to 2 are linear (m/s), 3 to 5 angular (rad/s),
            in the world's axes.
        time_constant: τ (s), at least as long as a command is held.
        regularization: ρ (1/kg, or 1/(kg m²) for angular components).

    Attributes:
        actuators: [n], the indices of the actuators that are commanded, from the arm's base to the hand.

    Raises:
        ValueError: if there is no such site; if one of its joints is not a hinge or slide with exactly one actuator,
            whose force is affine in its command, length and velocity; if the components are not some of 0 to 5, each
            once, or a number is out of its range.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        site: str,
        axes: Sequence[int] = range(6),
        time_constant: float = 0.1,
        regularization: float = 0.0,
    ):
        if not axes or len(set(axes)) < len(axes) or not set(axes) <= set(range(6)):
            raise ValueError(f"axes: got {list(axes)}, expected some of 0 to 5, each once")
        if time_constant <= 0:
            raise ValueError(f"time_constant: got {time_constant}, expected more than 0 s")
        if regularization < 0:
            raise ValueError(f"regularization: got {regularization}, expected at least 0")
        self._site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, site)
        if self._site < 0:
            names = ", ".join(model.site(i).name for i in range(model.nsite))
            raise ValueError(f"site: got {site!r}, expected one of {names or 'no site: the model has none'}")
        self._body = int(model.site_bodyid[self._site])
        joints = _joints_to(model, self._body)
        self.actuators = np.array([_actuator_of(model, joint) for joint in joints])
        self._qpos, self._dofs = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        self._axes, self._time, self._regularization = np.array(axes), time_constant, regularization
        self._gear = model.actuator_gear[self.actuators, 0]
        self._gain = model.actuator_gainprm[self.actuators, 0]
        affine = model.actuator_biastype[self.actuators] == mujoco.mjtBias.mjBIAS_AFFINE.value
        self._bias = affine[:, None] * model.actuator_biasprm[self.actuators, :3]

    def command(self, model: mjx.Model, data: mjx.Data, velocity: jax.Array) -> jax.Array:
        """Computes commands [n] of `actuators`, not clipped, that bring the hand to a velocity.

        At a singular pose, for example of a stretched arm, they are NaN or very large without regularization.

        Args:
            model: the robot.
            data: of which `qpos` and `qvel` are read.
            velocity: v* [k] (m/s, rad/s).
        """
        data = self._moving(model, data)
        jacobian = self._jacobian(model, data)[self._axes]
        joint_velocity = data.qvel[self._dofs]
        acceleration = (velocity - _product(jacobian, joint_velocity)) / self._time
        inertia = mjx.full_m(model, data)[np.ix_(self._dofs, self._dofs)]
        n, k = len(self._dofs), len(self._axes)
        through = solve_free(inertia, jacobian.T, jnp.ones(n, bool))  # M⁻¹ Jᵀ
        mobility = _product(jacobian, through) + self._regularization * jnp.eye(k, dtype=inertia.dtype)
        # Jᵀ Λ a + N M q̈_0 = M q̈_0 + Jᵀ Λ (a - J q̈_0)
        at_rest = -joint_velocity / self._time
        force = solve_free(mobility, acceleration - _product(jacobian, at_rest), jnp.ones(k, bool))
        bias = (data.qfrc_bias - data.qfrc_passive)[self._dofs]
        torque = _product(inertia, at_rest) + _product(jacobian.T, force) + bias
        length, speed = self._gear * data.qpos[self._qpos], self._gear * joint_velocity
        own = self._bias[:, 0] + self._bias[:, 1] * length + self._bias[:, 2] * speed
        return (torque / self._gear - own) / self._gain

    def _moving(self, model: mjx.Model, data: mjx.Data) -> mjx.Data:
        """Computes poses, velocities, inertias and bias forces."""
        for compute in (mjx.kinematics, mjx.com_pos, mjx.tendon, mjx.crb, mjx.tendon_armature):
            data = compute(model, data)
        for compute in (mjx.com_vel, mjx.passive, mjx.rne, mjx.tendon_bias):
            data = compute(model, data)
        return data

    def _jacobian(self, model: mjx.Model, data: mjx.Data) -> jax.Array:
        """Returns [6, n], from the joints' velocities to the hand's, in the world's axes."""
        linear, angular = mjx.jac(model, data, data.site_xpos[self._site], self._body)
        return jnp.concatenate([linear, angular], axis=1)[self._dofs].T


def _joints_to(model: mujoco.MjModel, body: int) -> list[int]:
    """Lists the joints that move a body, from the base on.

    Raises:
        ValueError: if there is none, or one that is neither a hinge nor a slide.
    """
    joints: list[int] = []
    while body:
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        joints, body = [*range(first, first + count), *joints], model.body_parentid[body]
    if not joints:
        raise ValueError("site: got one that no joint moves, expected one on an arm")
    for joint in joints:
        kind = _KINDS(model.jnt_type[joint])
        if kind not in (_KINDS.mjJNT_HINGE, _KINDS.mjJNT_SLIDE):
            raise ValueError(f"joint {model.joint(joint).name!r}: got {kind.name}, expected a hinge or a slide")
    return joints


def _actuator_of(model: mujoco.MjModel, joint: int) -> int:
    """Returns the actuator of a joint.

    Raises:
        ValueError: if there is not exactly one, or its force is not affine.
    """
    name = model.joint(joint).name
    on_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    found = np.flatnonzero(on_joint & (model.actuator_trnid[:, 0] == joint))
    if len(found) != 1:
        raise ValueError(f"joint {name!r}: got {len(found)} actuators, expected one")
    actuator = int(found[0])
    gain, bias = mujoco.mjtGain(model.actuator_gaintype[actuator]), mujoco.mjtBias(model.actuator_biastype[actuator])
    affine = gain == mujoco.mjtGain.mjGAIN_FIXED and bias in (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
    if not affine or model.actuator_dyntype[actuator] != mujoco.mjtDyn.mjDYN_NONE.value:
        raise ValueError(f"joint {name!r}: expected an actuator with a fixed gain, an affine bias and no activation")
    if not model.actuator_gear[actuator, 0] or not model.actuator_gainprm[actuator, 0]:
        raise ValueError(f"joint {name!r}: got an actuator whose gear or gain is 0, expected another number")
    if model.jnt_actgravcomp[joint]:
        raise ValueError(f"joint {name!r}: actgravcomp is not known here, expected false")
    return actuator
