"""The paper's prediction of the target: what a policy that acts remembers is what it was trained with."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.config import assemble
from milx.deploy import standalone
from milx.deploy.policy import Policy
from milx.evaluation import listening
from milx.evaluation.replay import replay
from milx.export import export
from milx.methods.mil import MIL, MILConfig
from milx.methods.whitening import Whitening
from milx.networks.policy_network import PolicyConfig, make_policy
from milx.types import Demo, Observation, Spec, TaskBatch

IMAGE_SHAPE, STATE, ACTION, STEPS, INDICES = (8, 10), 4, 2, 5, (1, 3)
WHITENING = Whitening(np.full(STATE, 0.1), np.full(STATE, 2.0), np.full(ACTION, 0.3), np.full(ACTION, 0.5))


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def case():
    """Makes MIL with a target head, its parameters, and one demonstration with all axes."""
    rng = np.random.default_rng(0)
    config = PolicyConfig(filters=(4,), strides=(2,), fc_layers=(8,), target_head=True)
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


def test_a_replay_is_a_loop_over_the_observations(case):
    method, params, demo = case
    one = jax.tree.map(lambda x: x[0], demo)
    memory, actions = method.initial_memory(jax.random.key(0)), []
    for t in range(STEPS):
        action, memory = method.act(params, Observation(one.image[t], one.state[t]), memory)
        actions.append(action)
    found = replay(method, params, one)
    np.testing.assert_allclose(found, actions, rtol=1e-12)
    alone = method.act(params, Observation(one.image[3], one.state[3]), method.initial_memory(jax.random.key(0)))[0]
    assert np.abs(alone - found[3]).max() > 1e-3


def test_listening_remembers_the_first_image(case):
    method, params, demo = case
    twice = jax.tree.map(lambda x: jnp.stack([x, x]), demo)
    found = jax.jit(functools.partial(listening.measure, method))(params, TaskBatch(twice, twice))
    error = np.square(replay(method, params, jax.tree.map(lambda x: x[0], demo)) - demo.action[0]).mean(axis=0)
    np.testing.assert_allclose(found["no_demo"], (error / np.var(demo.action[0], axis=0)).mean(), rtol=1e-9)


@pytest.mark.slow
def test_policies_with_a_memory_act_step_by_step(case, tmp_path):
    """Compares the policy and its export with the loop; without their memory they do not act at all."""
    method, _, demo = case
    config = assemble.default_config("mil")
    config.recorded.path, config.recorded.horizon = "a data set", STEPS
    spec = Spec(IMAGE_SHAPE, STATE, ACTION, None, INDICES)
    with jax.enable_x64(False):
        single = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), tree)  # noqa: E731
        params = method.init(jax.random.key(0), single(WHITENING))
        policy = Policy(method, spec, params, config)
        export(policy, tmp_path / "out")
        alone = standalone.Policy(tmp_path / "out")
        one = {"image": np.asarray(demo.image[0]), "state": np.asarray(demo.state[0], np.float32)}
        shown = one | {"action": np.asarray(demo.action[0], np.float32)}
        learned = policy.adapt(policy.params, Demo(**shown)), alone.adapt(**shown)
        expected = replay(method, learned[0], Demo(**jax.tree.map(jnp.asarray, one)))
        with pytest.raises(ValueError, match=r"memory: missing, expected `Policy\.step`"):
            policy.act(learned[0], Observation(one["image"][0], one["state"][0]))
        with pytest.raises(ValueError, match="memory: missing, expected `step`"):
            alone.act(learned[1], image=one["image"][0], state=one["state"][0])
        memories, found = [policy.initial_memory, alone.initial_memory], []
        for image, state in zip(one["image"], one["state"], strict=True):
            first, memories[0] = policy.step(learned[0], Observation(image, state), memories[0])
            second, memories[1] = alone.step(learned[1], memories[1], image=image, state=state)
            found.append((first, second))
        for each in zip(*found, strict=True):
            np.testing.assert_allclose(np.stack(each), expected, atol=1e-5)
