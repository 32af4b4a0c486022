"""Learns an expert that acts in every state: a network that minimizes an environment's cost by policy optimization.

Episodes begin in scenes of training tasks. In environments that say how things may be misjudged, half of them begin
after the policy has gone astray, since it supposed things far from where they are: so it learns to recover, for example
from beyond a thing that it was to push. In each time step of an episode the policy draws controls, which the
environment's steering turns into an action a_t; noise is added to it, as in demonstrations, and `Env.approximate_step`
follows. The rewards are minus the costs of the planners,

    r_t = -|running_residual(x_t, a_t, t)|^2 / 2,    of which the last has -|terminal_residual(x_T)|^2 / 2 besides,

and `ppo.py` maximizes their discounted sum; a_t is clipped to its range, and is without the noise. The policy sees what
the robot knows of itself, the positions of everything, the residual of the running cost at time 0 without an action,
which tells what is to be done, and what `Env.visible` adds. It is told the velocities of other things only where that
residual has them, since a single image does not show these. It supposes things where they are not (`Env.misjudge`), as
those who imitate it from images do, so it learns to act with a margin; when it demonstrates, it sees them where they
are. The critic sees both, all velocities and the time. Everything is whitened by the mean and the standard deviation
over all episodes so far. An episode that diverges is replaced by another one.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from milx.core import parallel, progress
from milx.envs.base import Env, State, Task
from milx.envs.steering import Steering
from milx.networks.mlp import MLP
from milx.trajopt import ppo
from milx.types import Params

OPTIONS = ppo.Options()
_FLOOR = 1e-3
"""Least standard deviation by which what is seen is divided."""
_FAR = 5.0
"""How many times as far off things are supposed by a policy that goes astray."""
_FARTHEST = 5.0
"""Whitened values are clipped to this."""


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of an expert that learns.

    Attributes:
        iterations: how often episodes are run and the policy is improved.
        episodes: N, in each iteration, rounded up to a multiple of the number of devices.
        astray: how long the policy goes astray, drawn uniformly up to this part of the horizon. It does not learn from
            that time, in which no noise is added.
        width: units of each of three hidden layers.
        deviation: standard deviation of the controls at first, in halves of their range.
        least: their least standard deviation; one that has come down to it stays there.
        options: of the optimization.

    Raises:
        ValueError: for a number that is out of range.
    """

    iterations: int = 500
    episodes: int = 4096
    astray: float = 0.4
    width: int = 256
    deviation: float = 0.5
    least: float = 0.08
    options: ppo.Options = OPTIONS

    def __post_init__(self) -> None:
        for field in ("iterations", "episodes", "width"):
            if (value := getattr(self, field)) < 1:
                raise ValueError(f"{field}: got {value}, expected at least 1")
        if self.astray < 0:
            raise ValueError(f"astray: got {self.astray}, expected at least 0")
        if not 0 < self.least <= self.deviation:
            raise ValueError(f"least: got {self.least}, expected more than 0 and at most deviation = {self.deviation}")


class Moments(NamedTuple):
    """Means over all episodes so far.

    Attributes:
        iterations: how often episodes were run.
        mean: [Z], of what is seen.
        square: [Z], of its square.
    """

    iterations: jax.Array
    mean: jax.Array
    square: jax.Array

    def add(self, seen: jax.Array) -> "Moments":
        """Takes the episodes of another iteration into account, [N, T, Z]."""
        weight = 1 / (self.iterations + 1)
        mean = self.mean + weight * (seen.mean(axis=(0, 1)) - self.mean)
        square = self.square + weight * (jnp.square(seen).mean(axis=(0, 1)) - self.square)
        return Moments(self.iterations + 1, mean, square)

    def whiten(self, seen: jax.Array) -> jax.Array:
        """Whitens the first entries of z [..., Z], as many as there are."""
        mean, square = self.mean[: seen.shape[-1]], self.square[: seen.shape[-1]]
        deviation = jnp.sqrt(jnp.maximum(square - jnp.square(mean), 0.0))
        return jnp.clip((seen - mean) / jnp.maximum(deviation, _FLOOR), -_FARTHEST, _FARTHEST)


class Actor(NamedTuple):
    """A policy that has learned.

    Attributes:
        moments: of what is seen.
        params: of the policy's network.
    """

    moments: Moments
    params: Params


class Learner(NamedTuple):
    """A policy that learns.

    Attributes:
        moments: of what is seen.
        unit: in which the critic estimates rewards: the standard deviation of their sums from each time step of the
            first episodes on.
        params: of the policy and of the critic, and the logarithm of the standard deviations.
        optimizer: the optimizer's state.
    """

    moments: Moments
    unit: jax.Array
    params: Params
    optimizer: optax.OptState


def see(env: Env, task: Task, state: State) -> jax.Array:
    """Returns what the policy sees [F]: the robot's state, positions, the residual without an action, and the rest."""
    residual = env.running_residual(task, state, jnp.zeros(env.action_size), jnp.int32(0))
    known = env.robot_state(state), state.qpos, state.mocap_pos.ravel(), residual, env.visible(task, state)
    return jnp.concatenate(known)


def act(env: Env, settings: Settings, actor: Actor, task: Task, state: State) -> jax.Array:
    """Returns the action [A] of a policy that has learned, which is clipped afterwards."""
    steering = env.steering
    policy, _ = _networks(env, settings)
    chosen = policy.apply(actor.params, actor.moments.whiten(see(env, task, state)))
    return steering.action(state, _controls(steering, jnp.asarray(chosen)))


def learn(env: Env, settings: Settings, noise: jax.Array | float, key: jax.Array) -> tuple[Actor, jax.Array]:
    """Learns an expert, and tells how far it is (`milx.core.progress`). Not to be called inside `jax.jit`.

    Args:
        env: the environment.
        settings: of the expert.
        noise: standard deviation of the noise on the actions, in their units.
        key: draws tasks, scenes, errors, controls, noise and minibatches.

    Returns:
        The policy, and the mean cost [iterations] of the episodes that it learned from, in which its controls spread.

    Raises:
        ValueError: unless the time steps of all episodes make minibatches of equal size.
        FloatingPointError: if all episodes of an iteration diverge.
    """
    rows = parallel.round_up(settings.episodes) * env.horizon
    if rows % (minibatches := settings.options.minibatches):
        raise ValueError(f"options.minibatches: got {minibatches}, expected a divisor of {rows}, all time steps")
    first_key, key = jax.random.split(key)
    noise, costs = jnp.asarray(noise, float), []
    learner = _begin(env, settings, noise, first_key)
    for number in range(settings.iterations):
        learner, cost = _improve(env, settings, noise, learner, jax.random.fold_in(key, number))
        costs.append(cost)
        progress.advance(1, f"cost {cost:.3g}")
        if not jnp.isfinite(cost):
            raise FloatingPointError(f"{env.name}: got a cost of {cost}, expected a finite one: all episodes diverge")
    return Actor(learner.moments, learner.params["policy"]), jnp.stack(costs)


def shapes(env: Env, settings: Settings) -> Actor:
    """Returns the shapes of the policy that `learn` returns."""
    learner = jax.eval_shape(lambda key: _begin(env, settings, jnp.zeros(()), key), jax.random.key(0))
    return Actor(learner.moments, learner.params["policy"])


def _controls(steering: Steering, chosen: jax.Array) -> jax.Array:
    """Returns controls [k] in the steering's units, of those that are chosen in halves of their range."""
    middle, half = (steering.low + steering.high) / 2, (steering.high - steering.low) / 2
    return middle + half * jnp.clip(chosen, -1.0, 1.0)


def _networks(env: Env, settings: Settings) -> tuple[MLP, MLP]:
    return MLP(len(env.steering.low), settings.width), MLP(1, settings.width)


def _apply(env: Env, settings: Settings, params: Params, seen: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Applies policy and critic to z, whitened."""
    policy, critic = _networks(env, settings)
    mean = policy.apply(params["policy"], seen[..., : _num_seen(env)])
    value = critic.apply(params["critic"], seen)
    log_deviation = jnp.maximum(params["deviation"], jnp.log(settings.least))
    return jnp.asarray(mean), log_deviation, jnp.asarray(value)[..., 0]


@functools.cache
def _num_seen(env: Env) -> int:
    """F, the part of z that the policy sees."""

    def first(key: jax.Array) -> jax.Array:
        task = env.sample_task(key, "train")
        return see(env, task, env.reset(key, task))

    return int(jax.eval_shape(first, jax.random.key(0)).shape[0])


def _episode(
    env: Env, settings: Settings, noise: jax.Array, moments: Moments, params: Params, key: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Runs an episode and returns z [T, Z], u [T, k] and r [T]."""
    task_key, scene_key, error_key, step_key, astray_key = jax.random.split(key, 5)
    task, steering = env.sample_task(task_key, "train"), env.steering
    low, high = env.action_range

    def choose(state: State, supposed: State, t: jax.Array, key: jax.Array) -> tuple[jax.Array, ...]:
        seen = jnp.concatenate([see(env, task, supposed), see(env, task, state), state.qvel, t[None] / env.horizon])
        mean, log_deviation, _ = _apply(env, settings, params, moments.whiten(seen))
        control = mean + jnp.exp(log_deviation) * jax.random.normal(key, mean.shape)
        return seen, control, jnp.clip(steering.action(state, _controls(steering, control)), low, high)

    def step(state: State, inputs: tuple[jax.Array, jax.Array]) -> tuple[State, tuple]:
        t, key = inputs
        control_key, noise_key = jax.random.split(key)
        seen, control, action = choose(state, env.misjudge(error_key, state), t, control_key)
        reward = -jnp.square(env.running_residual(task, state, action, t)).sum() / 2
        after = env.approximate_step(task, state, action + noise * jax.random.normal(noise_key, action.shape))
        return after, (seen, control, reward)

    def stray(state: State, inputs: tuple[jax.Array, jax.Array]) -> tuple[State, None]:
        t, key = inputs
        off = env.misjudge(far_key, state)
        far = jax.tree.map(lambda true, supposed: true + _FAR * (supposed - true), state, off)
        after = env.approximate_step(task, state, choose(state, far, t, key)[-1])
        return jax.tree.map(lambda new, old: jnp.where(t < until, new, old), after, state), None

    most = 0 if type(env).misjudge is Env.misjudge else round(settings.astray * env.horizon)
    until_key, far_key, stray_key = jax.random.split(astray_key, 3)
    until = jax.random.randint(until_key, (), -most, most + 1)
    keys = jax.random.split(stray_key, most)
    start = jax.lax.scan(stray, env.reset(scene_key, task), (jnp.arange(most), keys))[0]
    inputs = jnp.arange(env.horizon), jax.random.split(step_key, env.horizon)
    last, (seen, control, reward) = jax.lax.scan(step, start, inputs)
    return seen, control, reward.at[-1].add(-jnp.square(env.terminal_residual(task, last)).sum() / 2)


def _episodes(
    env: Env, settings: Settings, noise: jax.Array, moments: Moments, params: Params, key: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Runs the N episodes of an iteration; the first that is finite takes the place of those that are not."""
    run = jax.vmap(functools.partial(_episode, env, settings), in_axes=(None, None, None, 0))
    keys = jax.random.split(key, parallel.round_up(settings.episodes))
    found = parallel.shard_tasks(run, shared=3)(noise, moments, params, keys)
    finite = jnp.stack([jnp.isfinite(x).reshape(len(x), -1).all(axis=1) for x in found]).all(axis=0)
    rows = jnp.where(finite, jnp.arange(len(finite)), jnp.argmax(finite))
    return jax.tree.map(lambda x: x[rows], found)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _begin(env: Env, settings: Settings, noise: jax.Array, key: jax.Array) -> Learner:
    """Draws the networks, and whitens by the first episodes."""
    policy_key, critic_key, episode_key = jax.random.split(key, 3)
    policy, critic = _networks(env, settings)
    part, controls = _num_seen(env), len(env.steering.low)
    size = 2 * part + env.reset(key, env.sample_task(key, "train")).qvel.size + 1
    params = {
        "policy": policy.init(policy_key, jnp.zeros(part)),
        "critic": critic.init(critic_key, jnp.zeros(size)),
        "deviation": jnp.full(controls, jnp.log(settings.deviation), float),
    }
    moments = Moments(jnp.zeros(()), jnp.zeros(size), jnp.zeros(size))
    seen, _, reward = _episodes(env, settings, noise, moments, params, episode_key)
    sums = jnp.cumsum(reward[:, ::-1], axis=1)
    optimizer = ppo.optimizer(settings.options, settings.iterations)
    return Learner(moments.add(seen), jnp.maximum(sums.std(), 1e-6), params, optimizer.init(params))


@functools.partial(jax.jit, static_argnums=(0, 1))
def _improve(
    env: Env, settings: Settings, noise: jax.Array, learner: Learner, key: jax.Array
) -> tuple[Learner, jax.Array]:
    """Runs episodes, improves the policy and the critic, and returns the mean cost of the episodes, too."""
    episode_key, order_key = jax.random.split(key)
    moments, params, options = learner.moments, learner.params, settings.options
    seen, control, reward = _episodes(env, settings, noise, moments, params, episode_key)
    whitened = moments.whiten(seen)
    apply = functools.partial(_apply, env, settings)
    mean, log_deviation, value = apply(params, whitened)
    gain = jax.vmap(ppo.advantages, in_axes=(0, 0, None, None))(
        reward / learner.unit, value, options.discount, options.trace
    )
    chance = ppo.log_probability(control, mean, log_deviation)
    rows = ppo.Experience(whitened, control, chance, gain, gain + value)
    rows = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)
    optimizer = ppo.optimizer(options, settings.iterations)
    params, state = ppo.improve(apply, options, optimizer, (params, learner.optimizer), rows, order_key)
    return Learner(moments.add(seen), learner.unit, params, state), -reward.sum(axis=1).mean()
