"""MAML's relatives and the start from imitation, against their definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx import methods
from milx.config import assemble
from milx.core.pytrees import leaves
from milx.methods.mil import MIL, VARIANTS, MILConfig
from milx.methods.whitening import Whitening
from milx.networks.policy_network import PolicyConfig, PolicyNetwork, PolicyOutput, make_policy
from milx.types import Demo, Spec, TaskBatch

STATE, ACTION, TASKS, STEPS = 4, 2, 3, 5
THETA = np.array([0.4, -1.3])
ALPHA, M = 0.1, 1.7
SHRINK = 1 - 2 * ALPHA * M**2 / ACTION
"""What an inner step leaves of the distance between a constant policy and the mean action that it imitates."""


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


def random_demos(rng, *shape):
    draw = lambda size: jnp.asarray(rng.standard_normal((*shape, STEPS, size)))  # noqa: E731
    return Demo(state=draw(STATE), action=draw(ACTION))


@pytest.fixture(scope="module")
def batch():
    rng = np.random.default_rng(0)
    return TaskBatch(support=random_demos(rng, TASKS, 1), query=random_demos(rng, TASKS, 2))


PLAIN = Whitening(np.zeros(STATE), np.ones(STATE), np.zeros(ACTION), np.ones(ACTION))
CONSTANT = PolicyNetwork(
    init=lambda key: jnp.asarray(THETA),
    apply=lambda theta, image, state, *_: PolicyOutput(
        *[jnp.broadcast_to(theta, (len(state), ACTION))] * 2, goal=None, feature_map=None, features=state
    ),
)


def squared_error(theta, action):
    """Computes equation 2 of a constant policy."""
    return np.mean(M**2 * (np.asarray(theta)[..., None, None, :] - np.asarray(action)) ** 2)


def constant(**config):
    config = MILConfig(**{"inner_lr": ALPHA, "loss_scale": M, "inner_clip": 1e9} | config)
    return MIL(config, CONSTANT), {"policy": jnp.asarray(THETA), "whitening": PLAIN}


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_inner_step_changes_what_the_variant_says_and_nothing_else(batch, variant):
    network = make_policy(
        PolicyConfig(filters=(), strides=(), fc_layers=(8, 8), heads=2, bias_transformation=3), None, STATE, ACTION, 0
    )
    policy = jax.tree.map(
        lambda x: x + 0.2 * np.random.default_rng(1).standard_normal(x.shape), network.init(jax.random.key(0))
    )
    params, one = {"policy": policy, "whitening": PLAIN}, jax.tree.map(lambda x: x[0], batch.support)
    before, full, found = (
        leaves(jax.jit(MIL(MILConfig(inner_lr=lr, variant=kind), network).adapt)(params, one)["policy"])
        for lr, kind in ((0.0, "maml"), (ALPHA, "maml"), (ALPHA, variant))
    )
    output = {f"controller.{head}.{name}" for head in ("Dense_2", "Dense_3") for name in ("kernel", "bias")}
    acting = {name for name in output if "Dense_3" in name}  # of the head that the inner loss does not see
    changed = {
        "anil": output - acting,
        "boil": set(before) - output,
        "cavia": {"bias_transformation"},
    }.get(variant, set(before) - acting)
    assert {name for name in before if np.abs(found[name] - before[name]).max() > 0} == changed
    for name in changed:
        np.testing.assert_allclose(found[name], full[name], rtol=1e-12, err_msg=name)


@pytest.mark.parametrize(
    ("progress", "weights"), [(0.0, [1 / 3, 1 / 3, 1 / 3]), (0.7, [0.1, 0.1, 0.8]), (1.0, [0, 0, 1])]
)
def test_closed_form_of_the_multi_step_loss(batch, progress, weights):
    method, params = constant(variant="multi_step", inner_steps=3)
    mean = np.asarray(batch.support.action).mean(axis=(1, 2))
    after = [mean + SHRINK**i * (THETA - mean) for i in (1, 2, 3)]
    losses = [squared_error(theta, batch.query.action) for theta in after]
    loss, metrics = method.loss(params, batch, progress)
    np.testing.assert_allclose(loss, np.dot(weights, losses), rtol=1e-12)
    np.testing.assert_allclose(np.mean(metrics["action_loss"]), losses[-1], rtol=1e-12)


def test_imitation_takes_no_inner_step_and_sees_support_and_query(batch):
    method, params = constant()
    gradient = jax.jit(jax.grad(lambda params: method.imitation(params, batch)[0]))(params)["policy"]
    means = [np.asarray(demo.action).mean(axis=(0, 1, 2)) for demo in (batch.support, batch.query)]
    np.testing.assert_allclose(gradient, sum(2 * M**2 / ACTION * (THETA - mean) for mean in means), rtol=1e-12)
    loss, _ = method.imitation(params, batch)
    expected = squared_error(THETA, batch.support.action) + squared_error(THETA, batch.query.action)
    np.testing.assert_allclose(loss, expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method.variant": "reptile"}, "method.variant: got 'reptile', expected one of maml, anil"),
        ({"method.variant": "cavia", "network.bias_transformation": 0}, "network.bias_transformation: got 0"),
        ({"method.variant": "anil", "network.heads": 2}, "network.heads: got 2 with network.learned_loss=None"),
        (
            {"method.imitation_steps": 30_000},
            "method.imitation_steps: got 30000, expected less than train.steps = 30000",
        ),
        ({"method.variant": "multi_step"}, "method.inner_steps: got 1, expected at least 2"),
    ],
)
def test_a_variant_that_cannot_be_is_refused(changes, message):
    config = assemble.default_config("mil")
    for name, value in changes.items():
        assemble.assign(config, name, value)
    with pytest.raises(ValueError, match=message):
        methods.make(config, Spec(None, STATE, ACTION, None, ()))
