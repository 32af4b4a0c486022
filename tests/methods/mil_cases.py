"""Tiny cases of MIL that several files of tests look at."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from milx.methods.mil import MIL, MILConfig
from milx.methods.whitening import Whitening
from milx.networks.policy_network import PolicyConfig, PolicyNetwork, PolicyOutput, make_policy
from milx.types import Demo, TaskBatch

IMAGE_SHAPE, STATE, ACTION, TASKS, STEPS = (8, 10), 4, 2, 3, 5
GOAL_INDICES = (1, 3)
TINY = {"filters": (4, 4), "strides": (2, 2), "fc_layers": (8,), "bias_transformation": 3}
NO_CLIP = 1e9


def random_demos(rng, *shape):
    """Samples demonstrations with leading axes `shape`."""
    return Demo(
        image=jnp.asarray(rng.integers(0, 256, (*shape, STEPS, *IMAGE_SHAPE, 3), dtype=np.uint8)),
        state=jnp.asarray(rng.standard_normal((*shape, STEPS, STATE))),
        action=jnp.asarray(rng.standard_normal((*shape, STEPS, ACTION))),
        goal=jnp.asarray(rng.standard_normal((*shape, STEPS, len(GOAL_INDICES)))),
    )


def random_whitening(rng):
    return Whitening(
        state_mean=jnp.asarray(rng.standard_normal(STATE)),
        state_scale=jnp.asarray(rng.uniform(0.5, 2, STATE)),
        action_mean=jnp.asarray(rng.standard_normal(ACTION)),
        action_scale=jnp.asarray(rng.uniform(0.5, 2, ACTION)),
    )


@functools.cache
def random_params(**network):
    """Makes a tiny network and parameters that are nowhere zero."""
    policy = make_policy(PolicyConfig(**TINY | network), IMAGE_SHAPE, STATE, ACTION, len(GOAL_INDICES))
    rng = np.random.default_rng(1)
    draw = lambda leaf: jnp.asarray(np.asarray(leaf) + 0.2 * rng.standard_normal(leaf.shape))  # noqa: E731
    return policy, jax.tree.map(draw, jax.jit(policy.init)(jax.random.key(0)))


def build(network=None, **config):
    """Makes MIL on a tiny network, and its parameters."""
    policy, theta = random_params(**network or {})
    rng = np.random.default_rng(2)
    params = {"policy": theta, "whitening": random_whitening(rng)}
    if config.get("learn_inner_lr"):
        params["inner_log_lr"] = jax.tree.map(lambda _: jnp.asarray(0.3 * rng.standard_normal()), theta)
    return MIL(MILConfig(**{"inner_lr": 0.05, "inner_clip": NO_CLIP} | config), policy, GOAL_INDICES), params


def assert_trees_close(found, expected):
    """Asserts equality up to 1e-6 of each tensor's largest entry: programs round float32 images differently."""
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-6 * np.abs(b).max())  # noqa: E731
    jax.tree.map(close, found, expected)


def difference(after, before):
    return jax.tree.map(lambda a, b: np.asarray(a) - np.asarray(b), after, before)


def random_batch():
    """Samples a meta-batch of demonstrations."""
    rng = np.random.default_rng(0)
    return TaskBatch(support=random_demos(rng, TASKS, 1), query=random_demos(rng, TASKS, 2))


# A policy whose action is its parameter: everything has a closed form.
#
# With m the loss scale, A the size of the action, a and b the whitened support's and query's mean actions, an inner
# gradient is 2 m^2 / A (theta - a), so that n steps shrink theta - a by c^n with c = 1 - 2 alpha m^2 / A.

CONSTANT = PolicyNetwork(
    init=lambda key: jnp.zeros(ACTION),
    apply=lambda theta, image, state, *_: PolicyOutput(
        *[jnp.broadcast_to(theta, (len(state), ACTION))] * 2, goal=None, feature_map=None, features=state
    ),
)
THETA = np.array([0.4, -1.3])
ALPHA, M = 0.1, 1.7
SLOPE = 2 * M**2 / ACTION


def constant_mil(**config):
    return MIL(MILConfig(**{"inner_lr": ALPHA, "loss_scale": M, "inner_clip": NO_CLIP} | config), CONSTANT)
