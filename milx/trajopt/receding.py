"""Demonstrations by sampling with a receding horizon: nothing is planned to the end of an episode.

Every time step a search (`sampling.py`) looks `Env.ahead` time steps ahead, from the state that was reached and around
what is left of the last plan, and the first of its controls is executed (receding horizon, `replanning.py`).
The first plan begins with controls of zero, and where noise or contacts drive the robot off, the next one begins there.
The controls are those of `Env.steering`, candidates are rolled out by `Env.approximate_step`, and what is executed
happens by `Env.step`. Every plan pays the episode's terminal cost for its last state, wherever in the episode that is,
and at the end of an episode plans look beyond it, as if the running costs went on. All scenes draw the same candidates,
so that similar scenes are demonstrated alike, and a policy can learn what they have in common.

References:
    Howell et al., "Predictive sampling: real-time behaviour synthesis with MuJoCo", arXiv:2212.00541.
    Laskey et al., "DART: noise injection for robust imitation learning", CoRL 2017 (the recorded action is the one
    without noise).
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp

from milx.core import parallel
from milx.envs.base import Env, State, Task
from milx.trajopt import replanning, sampling
from milx.trajopt.episode import approximated, steered
from milx.trajopt.sampling import Options

SEARCH = Options("cross_entropy", samples=96, order=3, elites=4, deviation_min=0.03)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of demonstrations with a receding horizon.

    Attributes:
        knots: K, of a plan's spline; the time steps that are planned ahead where these are fewer.
        search: how a plan is improved.

    Raises:
        ValueError: for less than one knot.
    """

    knots: int = 4
    search: Options = SEARCH

    def __post_init__(self) -> None:
        if self.knots < 1:
            raise ValueError(f"knots: got {self.knots}, expected at least 1")


@functools.partial(jax.jit, static_argnums=(0, 1))
def demonstrate(
    env: Env, settings: Settings, noise: jax.Array | float, task: Task, start: State, key: jax.Array
) -> tuple[State, jax.Array]:
    """Demonstrates in a batch of N scenes.

    Args:
        env: the environment.
        settings: of the planner.
        noise: standard deviation of the noise on the actions, in their units.
        task: [N], what is to be done.
        start: [N], the scenes.
        key: [N], draw noise.

    Returns:
        The states, with leading axes [N, T + 1], and the actions without noise [N, T, A].

    Raises:
        ValueError: for an environment that looks less than one step ahead; as `replanning.control`.
    """
    if env.ahead < 1:
        raise ValueError(f"ahead of {env.name}: got {env.ahead}, expected at least 1")
    ahead, steering = min(env.ahead, env.horizon), env.steering
    first = sampling.start(jnp.zeros((min(settings.knots, ahead), len(steering.low))), steering.deviation)

    def one(noise: jax.Array, task: Task, start: State, key: jax.Array) -> tuple[State, jax.Array]:
        def plant(x: jax.Array, controls: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
            state = start.with_vector(x)
            action = jnp.clip(steering.action(state, controls), *env.action_range)
            noisy = action + noise * jax.random.normal(jax.random.fold_in(key, own), action.shape)
            return env.step(task, state, noisy).vector, action

        own, shared = jax.random.bits(key), jax.random.key(0)
        problem = approximated(steered(env, task, start))
        states, actions = replanning.control(
            problem, start.vector, first, ahead, env.horizon, 1, shared, settings.search, plant
        )
        return jax.vmap(start.with_vector)(states), actions

    batched = jax.vmap(one, in_axes=(None, 0, 0, 0))
    return parallel.shard_tasks(batched, shared=1)(jnp.asarray(noise, float), task, start, key)
