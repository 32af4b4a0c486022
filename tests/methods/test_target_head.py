"""The paper's prediction of the target: what a policy that acts remembers is what it was trained with."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.config import MILConfig, NetworkConfig
from milx.methods.maml import MIL
from milx.networks.policy import make_policy
from milx.types import Demo, Observation
from milx.whitening import Whitening

IMAGE_SHAPE, STATE, ACTION, STEPS, INDICES = (8, 10), 4, 2, 5, (1, 3)
WHITENING = Whitening(np.full(STATE, 0.1), np.full(STATE, 2.0), np.full(ACTION, 0.3), np.full(ACTION, 0.5))


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def case():
    """MIL with a target head, its parameters, and one demonstration with all axes."""
    rng = np.random.default_rng(0)
    config = NetworkConfig(filters=(4,), strides=(2,), fc_layers=(8,), target_head=True)
    network = make_policy(config, IMAGE_SHAPE, STATE, ACTION, len(INDICES))
    policy = jax.tree.map(lambda x: x + 0.3 * rng.standard_normal(x.shape), network.init(jax.random.key(0)))
    demo = Demo(
        image=jnp.asarray(rng.integers(0, 256, (1, STEPS, *IMAGE_SHAPE, 3), dtype=np.uint8)),
        state=jnp.asarray(rng.standard_normal((1, STEPS, STATE))),
        action=jnp.asarray(rng.standard_normal((1, STEPS, ACTION))),
        goal=jnp.asarray(rng.standard_normal((1, STEPS, len(INDICES)))),
    )
    return MIL(MILConfig(goal_weight=0.7), network, INDICES), {"policy": policy, "whitening": WHITENING}, demo


def test_acting_from_the_first_image_on_is_what_the_loss_sees(case):
    method, params, demo = case
    memory, actions = method.initial_memory(jax.random.key(0)), []
    for t in range(STEPS):
        action, memory = method.act(params, Observation(demo.image[0, t], demo.state[0, t]), memory)
        actions.append(action)
    white = (np.array(actions) - WHITENING.action_mean) / WHITENING.action_scale
    wanted = (np.asarray(demo.action[0]) - WHITENING.action_mean) / WHITENING.action_scale
    loss, parts = method.imitation_loss(params["policy"], WHITENING, demo)
    np.testing.assert_allclose(parts["action_loss"], np.mean((white - wanted) ** 2), rtol=1e-9)
    goal = (np.asarray(demo.goal[0]) - 0.1) / 2.0
    np.testing.assert_allclose(parts["target_loss"], np.mean((np.asarray(memory) - goal) ** 2), rtol=1e-9)
    np.testing.assert_allclose(loss, parts["action_loss"] + 0.7 * parts["target_loss"], rtol=1e-12)


def test_a_policy_without_a_memory_reads_the_target_off_every_image(case):
    method, params, demo = case
    one = Observation(demo.image[0, 3], demo.state[0, 3])
    action, memory = method.act(params, one, ())
    first = jax.tree.map(lambda x: x[:, 3:4], demo)
    _, parts = method.imitation_loss(params["policy"], WHITENING, dataclasses.replace(first, goal=None))
    white = (np.asarray(action) - np.asarray(first.action[0, 0])) / WHITENING.action_scale
    assert memory == () and "target_loss" not in parts
    np.testing.assert_allclose(parts["action_loss"], np.mean(white**2), rtol=1e-9)
