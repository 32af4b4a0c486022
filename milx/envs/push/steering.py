"""Push by velocities of the hand: an operational-space law turns them into torques, and keeps the hand upright."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp

from milx.envs.base import State
from milx.envs.operational_space import OperationalSpace
from milx.envs.steering import Steering

if TYPE_CHECKING:
    from milx.envs.push.env import Push

LIMITS = (0.3, 0.3, 0.225, 1.125)
"""Of the hand's velocity along x, y and z (m/s), and of its turning about z (rad/s). Policies imitate a slow hand more
easily than a fast one."""
DEVIATION = (0.135, 0.135, 0.135, 0.45)
"""Standard deviation of what the planner tries first, in the same units."""
UPRIGHT = 6.0
"""Rate at which the hand returns to pointing down (1/s)."""
TRACKING = 6.0
"""Rate at which the hand returns to its path (1/s)."""
TIME_CONSTANT, REGULARIZATION = 0.06, 1e-2
"""Of the law: its time constant (s), a little more than a time step, and what bounds torques near singular poses."""


def hand_velocity(env: "Push") -> Steering:
    """Makes the controls [4]: the hand's velocity along x, y and z (m/s), and its turning about z (rad/s)."""
    law = OperationalSpace(env.mj_model, "tip", time_constant=TIME_CONSTANT, regularization=REGULARIZATION)

    def pose(state: State) -> jax.Array:
        """Returns x, y, z (m) of the hand, and its turn about z (rad)."""
        hand = env.hand(state.qpos)
        return jnp.append(hand[:3], jnp.arctan2(hand[4], hand[3]))

    def action(state: State, velocity: jax.Array) -> jax.Array:
        tilt = jnp.cross(env.hand(state.qpos)[6:9], jnp.array([0.0, 0.0, -1.0]))
        wanted = jnp.concatenate([velocity[:3], UPRIGHT * tilt[:2], velocity[3:]])
        # The objects' masses do not matter to the arm's law.
        return law.command(env.model, env.data(state), wanted)

    def correction(state: State, expected: State) -> jax.Array:
        away = pose(expected) - pose(state)
        return TRACKING * away.at[3].set(jnp.arctan2(jnp.sin(away[3]), jnp.cos(away[3])))

    limits = jnp.array(LIMITS)
    return Steering(-limits, limits, jnp.array(DEVIATION), action, correction)
