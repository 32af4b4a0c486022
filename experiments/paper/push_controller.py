"""A controller that pushes an object to the goal, as an expert that rehearses (`data.expert=controller`).

It knows the task. Each time step it looks where the hand is and decides anew: rise and travel behind the object, seen
from the goal, come down, and push towards the goal. The hand's velocity becomes joint velocities by damped least
squares (Wampler 1986) and those become torques, which also overcome the object's friction. It has three ways to go
about a scene, of which it takes the first that succeeds in a rehearsal without noise.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from milx.config.schema import Config
from milx.core import parallel
from milx.core.batching import map_in_chunks
from milx.core.linear_algebra import solve_free
from milx.data import experts
from milx.envs.base import Env, State, Task
from milx.envs.push.env import NUM_JOINTS, Push, PushTask
from milx.trajopt.episode import judge
from milx.trajopt.expert import demonstrate

HIGH, LOW = 0.15, 0.008
"""Heights of the tip when it travels and when it pushes (m)."""
LIFTED = 0.06
"""Below this height (m) the hand pushes, if it is behind the object."""
MARGIN = 0.03
"""Gap between hand and object when the hand comes down (m)."""
SIDE = 0.035
"""The hand is behind the object if it is less than this off the line along which it is to push (m)."""
NEAR = 0.025
"""The hand comes down when it is closer than this to its place behind the object (m)."""
ARRIVED, BEYOND = 0.03, 0.03
"""The hand keeps still once the object is this close to the goal's center, or this far beyond it, where the hand does
not follow (m)."""
TRAVEL_SPEED, PUSH_SPEED, VERTICAL_SPEED = 0.8, 0.17, 0.6
"""m/s. Objects of little friction glide on: at twice this speed they cross the disc in fewer steps than count, and a
policy that pushes a little faster than its demonstrations fails."""
TACTICS = (0.0, 0.02, -0.02)
"""How far to the left of the object's center the hand pushes (m), in the order of preference: where a long thing turns
away from under a hand behind its center, another place may do."""
_FEEDBACK = (4.0, 4.0, 2.0, 3.0, 1.0, 1.0, 0.6)  # on the joints' velocities (N m s/rad)
_WEIGHTS = (1.0, 1.0, 1.0, *(0.03,) * 6)  # of the tip's velocity, and of the two directions'
_REGULARIZATION = 2e-3


def torque(
    pose: jax.Array,
    jacobian: jax.Array,
    velocity: jax.Array,
    damping: jax.Array,
    place: jax.Array,
    ahead: jax.Array,
    touching: jax.Array,
    aside: jax.Array,
    friction: jax.Array,
) -> jax.Array:
    """Computes the torques of the joints [7] (N m) for one time step.

    Args:
        pose: [9] tip position (m), unit vectors in which the hand pushes and in which its prongs point.
        jacobian: [9, 7] of the pose by the joint angles.
        velocity: [7] of the joints (rad/s).
        damping: [7] of the joints (N m s/rad).
        place: [2] of the object's center (m); the goal is at 0.
        ahead: [2] unit vector from the object's center to the goal.
        touching: how far behind the object's center the tip is when it touches the object (m).
        aside: how far to the left of the object's center, as the hand sees it, the hand pushes (m).
        friction: of the object against sliding (N s/m).
    """
    tip, away = pose[:3], jnp.linalg.norm(place)
    across = jnp.array([-ahead[1], ahead[0]])
    along, side = (tip[:2] - place) @ ahead, (tip[:2] - place) @ across - aside
    behind = (along < 0) & (along > -touching - 0.1) & (jnp.abs(side) < SIDE)
    pushing = behind & (tip[2] < LIFTED)

    to_place = place - (touching + MARGIN) * ahead + aside * across - tip[:2]
    far = jnp.linalg.norm(to_place) > NEAR
    risen = jnp.where(far, jnp.clip((tip[2] - 0.05) / 0.06, 0, 1), 1.0)
    travel = risen * _at_most(5.0 * to_place, TRAVEL_SPEED)
    speed = PUSH_SPEED * jnp.clip(away / 0.06, 0, 1)
    push = speed * ahead - 6.0 * side * across
    height = jnp.where(pushing | ~far, LOW, HIGH)
    wanted = jnp.concatenate(
        [
            jnp.where(pushing, push, travel),
            jnp.clip(6.0 * (height - tip[2:]), -VERTICAL_SPEED, VERTICAL_SPEED),
            3.0 * (jnp.append(ahead, 0.0) - pose[3:6]),
            6.0 * (jnp.array([0.0, 0.0, -1.0]) - pose[6:9]),
        ]
    )
    still = (away < ARRIVED) | (place[0] > BEYOND)
    wanted = jnp.where(still, 0.0, wanted)
    weighted = jnp.array(_WEIGHTS)[:, None] * jacobian
    normal = jacobian.T @ weighted + _REGULARIZATION * jnp.eye(7)
    joint_velocity = solve_free(normal, weighted.T @ wanted, jnp.ones(7, bool))
    force = jnp.where(pushing & ~still, friction * speed, 0.0) * ahead
    feedback = jnp.array(_FEEDBACK) * (joint_velocity - velocity)
    return damping * joint_velocity + feedback + jacobian[:2].T @ force


def _at_most(velocity: jax.Array, speed: float) -> jax.Array:
    """Slows the velocity down to this speed."""
    return velocity * jnp.minimum(1, speed / jnp.maximum(jnp.linalg.norm(velocity), 1e-6))


def control(env: Push, task: PushTask, state: State, tactic: jax.Array) -> jax.Array:
    """Returns the action [7] of the controller in one state, by one of the TACTICS."""
    target = task.target
    place = env.objects(state)[target, :2]
    pose, jacobian = env.hand(state.qpos), jax.jacfwd(env.hand)(state.qpos[:NUM_JOINTS])
    ahead = -place / jnp.maximum(jnp.linalg.norm(place), 0.02)
    touching = env.outline(task, state, -ahead[None])[0] + env.mj_model.geom("prong_middle").size[0]
    joints, velocity = env.model.dof_damping[:NUM_JOINTS], state.qvel[:NUM_JOINTS]
    found = torque(pose, jacobian, velocity, joints, place, ahead, touching, tactic, task.damping[target])
    return jnp.clip(found / env.mj_model.actuator_gear[:, 0], *env.action_range)


class Controlled(NamedTuple):
    """An expert that acts by a controller.

    Attributes:
        control: returns the action [A] of one state, given environment, task, state and tactic.
        tactics: what may succeed, in the order of preference.
    """

    control: Callable[[Any, Any, State, jax.Array], jax.Array]
    tactics: tuple[float, ...]

    def perform(self, env: Env, task: Task, state: State, key: jax.Array, noise: float) -> tuple[State, jax.Array]:
        """Demonstrates by the tactics that `choose` finds, see `milx.trajopt.expert.Expert`."""
        return _perform(env, self.control, noise, task, state, self.choose(env, task, state), key)

    def choose(self, env: Env, task: Task, state: State) -> np.ndarray:
        """Finds, for each of N scenes, the first tactic [N] that succeeds without noise.

        Where no tactic succeeds it is the first of all. Only scenes in which the tactics before have failed rehearse
        the next one.
        """
        chosen = np.full(len(state.qpos), self.tactics[0])
        unsolved = np.arange(len(chosen)) if len(self.tactics) > 1 else np.array([], int)

        def rehearse(tactic: float, task: Task, state: State) -> jax.Array:
            count = len(state.qpos)
            keys = jax.random.split(jax.random.key(0), count)  # of noise that is multiplied by zero
            states, _ = _perform(env, self.control, 0.0, task, state, np.full(count, tactic), keys)
            return judge(env, task, states)[0]

        for tactic in self.tactics:
            if len(unsolved):
                attempt = functools.partial(rehearse, tactic)
                success = np.asarray(map_in_chunks(attempt, (task, state), len(chosen), counted=False, rows=unsolved))
                chosen[unsolved[success]] = tactic
                unsolved = unsolved[~success]
        return chosen


@functools.partial(jax.jit, static_argnums=(0, 1))
def _perform(env: Env, control: Callable, noise: float, *batch: Any) -> tuple[State, jax.Array]:
    def one(noise: float, task: Task, state: State, tactic: jax.Array, key: jax.Array) -> tuple[State, jax.Array]:
        return demonstrate(env, task, state, lambda state, _: control(env, task, state, tactic), key, noise)

    return parallel.shard_tasks(jax.vmap(one, in_axes=(None, 0, 0, 0, 0)), shared=1)(noise, *batch)


CONTROLLER = Controlled(control, TACTICS)
"""Push's."""


def _for_push(env: Env, _: Any) -> Controlled:
    if env.name != "push":
        raise ValueError(f"data.expert: got 'controller', expected another one with {env.name}: it knows push only")
    return CONTROLLER


experts.EXPERTS["controller"] = experts.Kind(
    _for_push, lambda *run: ["controller", *_for_push(*run).tactics], plans=False
)


def let_control(config: Config) -> Config:
    """Lets the controller demonstrate push, and restores what the presets had for its demonstrations."""
    if config.env_name == "push":
        config.data.expert, config.data.plan_iterations, config.env.goal_step = "controller", 0, None
        if config.preset == "cpu":
            config.data.tasks, config.data.demos_per_task, config.data.noise = 200, 6, 0.1
            config.train.steps, config.train.eval_every = 5000, 2500
        else:
            config.train.frame_exponent = 1.0
    return config
