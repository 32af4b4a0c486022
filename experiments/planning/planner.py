"""A planner of pushes that knows no controller: it samples velocities of the hand, with the environment's costs.

An operational-space law turns the velocities into torques, and keeps the hand upright. Candidates may be rolled out in
a cheaper model than the environment's.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from milx import envs
from milx.envs.base import State
from milx.envs.push.env import Push, PushTask
from milx.trajopt import replanning, sampling
from milx.trajopt.expert import problem_of
from milx.trajopt.ilqr import Problem
from milx.trajopt.operational_space import OperationalSpace, with_controls
from milx.trajopt.sampling import Options, Search

KNOTS = 10
LIMITS = (0.8, 0.8, 0.6, 3.0)
"""Of the hand's velocity along x, y and z (m/s), and of its turning about z (rad/s)."""
DEVIATION = (0.3, 0.3, 0.3, 1.0)
"""Standard deviation of the first candidates, in the same units."""
NEAR = 0.3
"""The deviation of the first candidates around a plan that is nearly right, as a fraction of DEVIATION."""
UPRIGHT = 6.0
"""Rate at which the hand returns to pointing down (1/s)."""
TIME_CONSTANT, REGULARIZATION = 0.06, 1e-2
"""Of the law: its time constant (s), a little more than a time step, and what bounds torques near singular poses."""
TRACKING = 6.0
"""Rate at which the hand returns to its path when it tracks it (1/s)."""


def make_env() -> Push:
    """Makes the environment, whose images do not matter."""
    return envs.make("push", (16, 16))


def make_cheap_env() -> Push:
    """Makes the environment with cheaper physics.

    A time step of 0.05 s has three physics steps of 0.0167 s instead of five of 0.01 s, and the contact solver does two
    iterations with at most four evaluations in each line search instead of six with eight.
    """
    env = make_env()
    step = env.mj_model.opt.timestep * env.substeps / 3
    env.substeps = 3
    env.model = env.model.replace(
        opt=env.model.opt.replace(iterations=2, ls_iterations=4, timestep=jnp.asarray(step, float))
    )
    return env


class Planner:
    """Plans pushes and executes them.

    Args:
        env: where plans are executed.
        options: how plans are searched for.
        model: where candidates are rolled out; `env` by default.
    """

    def __init__(self, env: Push, options: Options, model: Push | None = None):
        self.env, self.options, self._model = env, options, model or env
        self._law = OperationalSpace(env.mj_model, "tip", time_constant=TIME_CONSTANT, regularization=REGULARIZATION)

    def problem(self, task: PushTask, start: State) -> Problem:
        """States the problem of a scene, with the environment's costs, in velocities of the hand."""
        problem = problem_of(self._model, task, start)
        limits = jnp.array(LIMITS)
        return with_controls(problem, lambda x, v: self._action(start.with_vector(x), v), -limits, limits)

    def start(self, scenes: int) -> Search:
        """Begins a search [scenes] without any plan."""
        begin = jax.vmap(sampling.start, in_axes=None, axis_size=scenes)
        return begin(jnp.zeros((KNOTS, len(LIMITS))), jnp.array(DEVIATION))

    @functools.partial(jax.jit, static_argnums=0)
    def start_from(self, task: PushTask, start: State, plans: jax.Array) -> Search:
        """Begins a search in every scene, from the cheapest of its own plans [scenes, M, KNOTS, 4]."""

        def one(task: PushTask, start: State, plans: jax.Array) -> Search:
            problem, deviation = self.problem(task, start), NEAR * jnp.array(DEVIATION)
            return sampling.start_from(problem, start.vector, plans, deviation, self.env.horizon, self.options)

        return jax.vmap(one)(task, start, plans)

    @functools.partial(jax.jit, static_argnums=0)
    def improve(self, task: PushTask, start: State, search: Search, key: jax.Array) -> Search:
        """Does the options' iterations in every scene; `key` is [scenes]."""

        def one(task: PushTask, start: State, search: Search, key: jax.Array) -> Search:
            problem = self.problem(task, start)
            return sampling.solve(problem, start.vector, search, self.env.horizon, key, self.options)

        return jax.vmap(one)(task, start, search, key)

    @functools.partial(jax.jit, static_argnums=(0, 5, 6))
    def execute(
        self,
        task: PushTask,
        start: State,
        search: Search,
        key: jax.Array,
        every: int,
        again: Options,
        noise: jax.Array | float,
        rate: jax.Array | float,
    ) -> jax.Array:
        """Executes the plans.

        Args:
            task: [scenes].
            start: [scenes], where they begin.
            search: [scenes], their plans.
            key: [scenes], for noise and candidates.
            every: time steps after which what is left is planned again; the horizon to keep the plans.
            again: settings of planning again, whose candidates deviate by NEAR of DEVIATION.
            noise: standard deviation on the actions, which lie in [-1, 1].
            rate: at which the hand returns to the path that the model expects of the last plan (1/s); velocities that
                return it may exceed LIMITS.

        Returns:
            In which scenes that succeeded, [scenes].
        """

        def one(task: PushTask, start: State, search: Search, key: jax.Array) -> jax.Array:
            def plant(x: jax.Array, velocity: jax.Array, expected: jax.Array, key: jax.Array) -> jax.Array:
                state = start.with_vector(x)
                away = self._hand(start.with_vector(expected)) - self._hand(state)
                away = away.at[3].set(jnp.arctan2(jnp.sin(away[3]), jnp.cos(away[3])))
                action = jnp.clip(self._action(state, velocity + rate * away), *self.env.action_range)
                return self.env.step(task, state, action + noise * jax.random.normal(key, action.shape)).vector

            search = search._replace(deviation=jnp.broadcast_to(NEAR * jnp.array(DEVIATION), search.deviation.shape))
            states, _ = replanning.execute(
                self.problem(task, start),
                start.vector,
                search,
                self.env.horizon,
                every,
                key,
                again,
                plant,
            )
            return self.env.success(task, jax.vmap(start.with_vector)(states))

        return jax.vmap(one)(task, start, search, key)

    @functools.partial(jax.jit, static_argnums=0)
    def features(self, task: PushTask, start: State) -> jax.Array:
        """Describes each scene by the running residual [scenes, R] of its first state, without an action."""
        zero = jnp.zeros(self.env.action_size)
        return jax.vmap(lambda task, start: self.env.running_residual(task, start, zero, jnp.int32(0)))(task, start)

    def _action(self, state: State, velocity: jax.Array) -> jax.Array:
        """Computes the actions [7], not clipped, that move the hand so (velocity [4]) and keep it upright."""
        tilt = jnp.cross(self.env.hand(state.qpos)[6:9], jnp.array([0.0, 0.0, -1.0]))
        wanted = jnp.concatenate([velocity[:3], UPRIGHT * tilt[:2], velocity[3:]])
        # The objects' masses do not matter to the arm's law.
        return self._law.command(self.env.model, self.env.data(state), wanted)

    def _hand(self, state: State) -> jax.Array:
        """Returns x, y, z (m) of the hand, and its turn about z (rad)."""
        hand = self.env.hand(state.qpos)
        return jnp.append(hand[:3], jnp.arctan2(hand[4], hand[3]))


def nearest(features: jax.Array, others: np.ndarray, count: int) -> np.ndarray:
    """Returns the indices [N, count] of the rows of `others` [M, R] that are nearest to each of `features` [N, R].

    Raises:
        ValueError: if there are fewer rows than `count`.
    """
    if len(others) < count:
        raise ValueError(f"count: got {count}, expected at most {len(others)}, the plans that there are")
    # The features' own squares are left out: they are the same for a whole row.
    squares = (others**2).sum(axis=1) - 2 * np.asarray(features) @ others.T
    return np.argpartition(squares, count - 1, axis=1)[:, :count]


def draw(env: Push, scenes: int, seed: int) -> tuple[PushTask, State, jax.Array]:
    """Draws training tasks and a scene of each, [scenes], and a key for what else happens there."""
    task_key, scene_key, key = jax.random.split(jax.random.key(seed), 3)
    task = jax.vmap(env.sample_task, in_axes=(0, None))(jax.random.split(task_key, scenes), "train")
    return task, jax.vmap(env.reset)(jax.random.split(scene_key, scenes), task), key
