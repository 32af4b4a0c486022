"""Proximal policy optimization of a Gaussian policy, from N episodes of T steps each.

The policy draws controls u_t from a normal distribution with mean m(z_t) and standard deviations s, and is to maximize
the discounted sum of the rewards r_t. A critic V estimates this sum from z_t, of which the policy may see a part only.
With the policy and critic that drew the episodes, p' and V', the generalized advantages are

    A_t = sum_{k >= 0} (g l)^k d_{t+k},        d_t = r_t + g V'(z_{t+1}) - V'(z_t),        V'(z_T) = 0,

and steps of Adam in minibatches minimize the mean of

    -min(w B, clip(w, 1 - e, 1 + e) B) + (V(z) - A - V'(z))^2 / 2,        w = p(u | z) / p'(u | z),

where B is A without its mean in the minibatch, over its standard deviation.

References:
    Schulman et al., "Proximal policy optimization algorithms", 2017 (equation 7).
    Schulman et al., "High-dimensional continuous control using generalized advantage estimation", ICLR 2016
    (equation 16).
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from milx.types import Params


@dataclasses.dataclass(frozen=True)
class Options:
    """Options of the optimization.

    Attributes:
        epochs: how often the steps go through all episodes.
        minibatches: number of steps in an epoch; it divides N T.
        discount: g.
        trace: l.
        clip: e.
        rate: learning rate at the beginning; it falls to a tenth of that, linearly.
        norm: to which the gradient is clipped.
    """

    epochs: int = 4
    minibatches: int = 32
    discount: float = 0.99
    trace: float = 0.95
    clip: float = 0.2
    rate: float = 3e-4
    norm: float = 1.0


class Experience(NamedTuple):
    """Episodes, or rows of them, with any leading axes.

    Attributes:
        seen: [..., Z], z.
        control: [..., k], u.
        log_probability: [...], log p'(u | z) without its constant.
        advantage: [...], A.
        target: [...], A + V'(z).
    """

    seen: jax.Array
    control: jax.Array
    log_probability: jax.Array
    advantage: jax.Array
    target: jax.Array


Networks = Callable[[Params, jax.Array], tuple[jax.Array, jax.Array, jax.Array]]
"""Maps parameters and z [..., Z] to the mean m [..., k], the logarithm of s [k], and V [...]."""


def log_probability(control: jax.Array, mean: jax.Array, log_deviation: jax.Array) -> jax.Array:
    """Computes log p(u | z) [...] of controls [..., k], without the constant -k log(2 pi) / 2."""
    off = (control - mean) * jnp.exp(-log_deviation)
    return -(jnp.square(off) / 2 + log_deviation).sum(axis=-1)


def advantages(reward: jax.Array, value: jax.Array, discount: float, trace: float) -> jax.Array:
    """Computes A [T] from the rewards [T] and values V' [T] of an episode."""
    later = jnp.append(value[1:], 0.0)

    def back(after: jax.Array, change: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = change + discount * trace * after
        return found, found

    return jax.lax.scan(back, jnp.zeros(()), reward + discount * later - value, reverse=True)[1]


def loss(networks: Networks, params: Params, rows: Experience, clip: float) -> jax.Array:
    """Computes the loss of a minibatch of rows [M]."""
    mean, log_deviation, value = networks(params, rows.seen)
    ratio = jnp.exp(log_probability(rows.control, mean, log_deviation) - rows.log_probability)
    gain = (rows.advantage - rows.advantage.mean()) / jnp.maximum(rows.advantage.std(), 1e-6)
    surrogate = jnp.minimum(ratio * gain, jnp.clip(ratio, 1 - clip, 1 + clip) * gain)
    return (jnp.square(value - rows.target) / 2 - surrogate).mean()


def optimizer(options: Options, iterations: int) -> optax.GradientTransformation:
    """Makes the optimizer of as many calls of `improve`."""
    steps = iterations * options.epochs * options.minibatches
    schedule = optax.linear_schedule(options.rate, options.rate / 10, steps)
    return optax.chain(optax.clip_by_global_norm(options.norm), optax.adam(schedule))


def improve(
    networks: Networks,
    options: Options,
    optimizer: optax.GradientTransformation,
    learned: tuple[Params, Any],
    rows: Experience,
    key: jax.Array,
) -> tuple[Params, Any]:
    """Takes the steps of all epochs.

    Args:
        networks: policy and critic.
        options: of the optimization.
        optimizer: from `optimizer`.
        learned: parameters, and the optimizer's state.
        rows: [M] of all episodes, M = N T.
        key: draws the minibatches.

    Returns:
        The new parameters and state.
    """
    count = len(rows.target)

    def step(learned: tuple[Params, Any], index: jax.Array) -> tuple[tuple[Params, Any], None]:
        params, state = learned
        part = jax.tree.map(lambda x: x[index], rows)
        gradient = jax.grad(loss, argnums=1)(networks, params, part, options.clip)
        change, state = optimizer.update(gradient, state, params)
        return (optax.apply_updates(params, change), state), None

    def epoch(learned: tuple[Params, Any], key: jax.Array) -> tuple[tuple[Params, Any], None]:
        order = jax.random.permutation(key, count).reshape(options.minibatches, -1)
        return jax.lax.scan(step, learned, order)

    return jax.lax.scan(epoch, learned, jax.random.split(key, options.epochs))[0]
