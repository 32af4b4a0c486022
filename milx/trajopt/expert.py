"""Experts: who demonstrates a batch of scenes, with noise on the actions.

iLQR plans every scene once, and the plan's feedback is run. The noise drives the arm off the plan and the recorded
action is the feedback's answer, before the noise: a demonstration so shows how to recover, and its labels are clean
(DART, Laskey et al. 2017). An expert by sampling (`demonstrations.py`) does the same with its own plans and its own way
to follow them, one with a receding horizon (`receding.py`) plans again where the noise has driven it, and one that has
learned (`learned.py`) acts in every state.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from milx.core import parallel
from milx.envs.base import Env, State, Task
from milx.trajopt import demonstrations, learned, receding
from milx.trajopt.episode import problem_of
from milx.trajopt.ilqr import Options, Plan, solve
from milx.trajopt.planner import Plans, Settings

VERSION = 4
"""Of all that plans, learns and demonstrates, also outside milx: raised when it does so differently with
the same settings, so that no demonstration planned before it is taken for one planned after it."""


def plan(env: Env, task: Task, state: State, options: Options) -> Plan:
    """Plans one episode from `state`: iLQR on the environment's costs, started from the environment's guess."""
    return solve(problem_of(env.differentiable, task, state), state.vector, env.guess(task, state), options)


class Expert(Protocol):
    """Who demonstrates."""

    def perform(self, env: Env, task: Task, state: State, key: jax.Array, noise: float) -> tuple[State, jax.Array]:
        """Demonstrates in a batch of N scenes. Not to be called inside `jax.jit`.

        Args:
            env: the environment.
            task: [N], what is to be done.
            state: [N], the scenes.
            key: [N], draw the noise.
            noise: standard deviation of the noise on the actions, in their units.

        Returns:
            The states, with leading axes [N, T + 1], and the actions without noise [N, T, A].
        """


class Planned(NamedTuple):
    """An expert that plans by iLQR and follows its plans.

    Attributes:
        options: of iLQR.
    """

    options: Options

    def perform(self, env: Env, task: Task, state: State, key: jax.Array, noise: float) -> tuple[State, jax.Array]:
        """Demonstrates, see `Expert`."""
        return _perform_planned(env, self.options, noise, task, state, key)


class Sampling(NamedTuple):
    """An expert that plans whole episodes by sampling.

    Attributes:
        settings: of the planner.
        plans: of other scenes, with which it begins.
    """

    settings: Settings
    plans: Plans

    def perform(self, env: Env, task: Task, state: State, key: jax.Array, noise: float) -> tuple[State, jax.Array]:
        """Demonstrates, see `Expert`."""
        return demonstrations.demonstrate(env, self.settings, self.plans, noise, task, state, key)


class Receding(NamedTuple):
    """An expert that plans the next time steps by sampling, again and again.

    Attributes:
        settings: of the planner.
    """

    settings: receding.Settings

    def perform(self, env: Env, task: Task, state: State, key: jax.Array, noise: float) -> tuple[State, jax.Array]:
        """Demonstrates, see `Expert`.

        Raises:
            ValueError: as `receding.demonstrate`.
        """
        return receding.demonstrate(env, self.settings, noise, task, state, key)


class Learned(NamedTuple):
    """An expert that has learned.

    Attributes:
        settings: with which it learned.
        actor: what it learned.
    """

    settings: learned.Settings
    actor: learned.Actor

    def perform(self, env: Env, task: Task, state: State, key: jax.Array, noise: float) -> tuple[State, jax.Array]:
        """Demonstrates, see `Expert`."""
        return _perform_learned(env, self.settings, self.actor, noise, task, state, key)


Feedback = Callable[[State, jax.Array], jax.Array]
"""Maps a state and the time step (int32 scalar) to an action [A]."""


def follow(plan: Plan) -> Feedback:
    """Makes the feedback that follows a plan linearly."""
    return lambda state, t: plan.actions[t] + plan.gains[t] @ (state.vector - plan.states[t])


def demonstrate(
    env: Env, task: Task, state: State, feedback: Feedback, key: jax.Array, noise: float
) -> tuple[State, jax.Array]:
    """Runs feedback from `state` with Gaussian noise of standard deviation `noise` on the actions.

    Args:
        env: the environment.
        task: what is to be done.
        state: the scene.
        feedback: who acts.
        key: draws the noise.
        noise: in units of the action.

    Returns:
        The states, with a leading axis T + 1, and the feedback's noiseless actions [T, A].
    """
    low, high = env.action_range

    def step(state: State, inputs: tuple[jax.Array, jax.Array]) -> tuple[State, tuple[State, jax.Array]]:
        t, key = inputs
        action = jnp.clip(feedback(state, t), low, high)
        after = env.step(task, state, action + noise * jax.random.normal(key, action.shape))
        return after, (state, action)

    keys = jax.random.split(key, env.horizon)
    last, (states, actions) = jax.lax.scan(step, state, (jnp.arange(env.horizon), keys))
    return jax.tree.map(lambda xs, x: jnp.concatenate([xs, x[None]]), states, last), actions


@functools.partial(jax.jit, static_argnums=(0, 1))
def _perform_planned(env: Env, options: Options, noise: float, *batch: Any) -> tuple[State, jax.Array]:
    def one(noise: float, task: Task, state: State, key: jax.Array) -> tuple[State, jax.Array]:
        return demonstrate(env, task, state, follow(plan(env, task, state, options)), key, noise)

    return parallel.shard_tasks(jax.vmap(one, in_axes=(None, 0, 0, 0)), shared=1)(noise, *batch)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _perform_learned(
    env: Env, settings: learned.Settings, actor: learned.Actor, noise: float, *batch: Any
) -> tuple[State, jax.Array]:
    def one(actor: learned.Actor, noise: float, task: Task, state: State, key: jax.Array) -> tuple[State, jax.Array]:
        return demonstrate(
            env, task, state, lambda state, _: learned.act(env, settings, actor, task, state), key, noise
        )

    return parallel.shard_tasks(jax.vmap(one, in_axes=(None, None, 0, 0, 0)), shared=2)(actor, noise, *batch)
