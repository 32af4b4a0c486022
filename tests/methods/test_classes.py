"""Entries of actions that take two values, such as a gripper's: their loss, their whitening, and what is done."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from told import Told

from milx import methods
from milx.config.assemble import make_config
from milx.data import episodes
from milx.data.dataset import DataSet, Writer
from milx.data.episodes import Contents
from milx.methods import whitening
from milx.methods.chunks import Chunked
from milx.methods.imitation import behavioral_cloning
from milx.networks.policy_network import PolicyOutput
from milx.types import Demo, Observation, Spec

RNG = np.random.default_rng(0)
OPEN, CLOSED = 0.08, 0.0
GRIP = np.where(RNG.random(50) < 0.3, OPEN, CLOSED)
STATE = RNG.normal(size=(50, 3)).astype(np.float32)
ACTION = np.stack([RNG.normal(2.0, 3.0, 50), GRIP], axis=1).astype(np.float32)
FITTED = whitening.fit(jnp.asarray(STATE), jnp.asarray(ACTION), True, (1,))


def method(name="mil", chunk=1, execute=1):
    config = make_config("recorded", name, "cpu")
    config.network.filters = config.network.strides = ()
    config.network.soft_argmax = config.network.mixed_precision = False
    config.network.fc_layers, config.recorded.path = (8,), "set"
    config.method.chunk, config.method.execute = chunk, execute
    spec = Spec(None, 3, 2, None, (), class_indices=(1,))
    return methods.make(config, spec), methods.classes(config, spec)


def test_the_two_values_become_minus_one_and_one_whatever_is_whitened():
    for whiten in (True, False):
        fitted = whitening.fit(jnp.asarray(STATE), jnp.asarray(ACTION), whiten, (1,))
        white = np.asarray(fitted.action(jnp.asarray(ACTION)))
        np.testing.assert_allclose(white[:, 1], np.where(GRIP == OPEN, 1, -1), atol=1e-5)
        np.testing.assert_allclose(fitted.unwhiten_action(white), ACTION, atol=1e-5)
        expected = (ACTION[:, 0] - ACTION[:, 0].mean()) / ACTION[:, 0].std() if whiten else ACTION[:, 0]
        np.testing.assert_allclose(white[:, 0], expected, atol=1e-4)
    said = np.array([[0.3, -0.2], [0.0, 7.0], [1.0, 0.0]], np.float32)
    done = np.asarray(FITTED.unwhiten_action(jnp.asarray(said), (1,)))
    np.testing.assert_allclose(done[:, 1], [CLOSED, OPEN, OPEN], atol=1e-6)


def test_the_loss_of_a_class_is_its_negative_log_likelihood():
    """Compares with probabilities in NumPy; the other entry keeps its square."""
    config = method()[0].config
    config = dataclasses.replace(config, loss_scale=1.5, goal_weight=0.0)
    said = RNG.normal(size=(50, 2)).astype(np.float32)
    demo = Demo(None, jnp.asarray(STATE)[None], jnp.asarray(ACTION)[None])
    output = PolicyOutput(jnp.asarray(said), jnp.asarray(said), None, None, jnp.asarray(said))
    loss, parts = behavioral_cloning(config, output, jnp.asarray(said), demo, FITTED, (), (1,))
    probability = 1 / (1 + np.exp(-2 * said[:, 1]))
    likelihood = np.where(GRIP == OPEN, probability, 1 - probability)
    square = (said[:, 0] - np.asarray(FITTED.action(jnp.asarray(ACTION)))[:, 0]) ** 2
    expected = 1.5**2 * np.mean([square, -np.log(likelihood)])
    assert float(loss) == pytest.approx(expected, rel=1e-5)
    assert float(parts["action_loss"]) == pytest.approx(expected, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mil", "contextual"])
def test_a_policy_does_one_of_the_two_values(name):
    """Adapts to random demonstrations and acts on random observations: both values are done, and nothing between."""
    made, _ = method(name)
    demo, done = Demo(None, jnp.asarray(STATE)[None], jnp.asarray(ACTION)[None]), []
    for seed in range(6):
        learned = made.adapt(made.init(jax.random.key(seed), FITTED), demo)
        act = jax.vmap(lambda state: made.act(learned, Observation(state=state), ())[0])  # noqa: B023
        done.append(act(5 * STATE))
    done = np.concatenate(done)
    np.testing.assert_allclose(np.unique(done[:, 1].round(4)), [CLOSED, OPEN], atol=1e-4)
    assert len(np.unique(done[:, 0])) > 200


def test_a_mean_over_chunks_leaves_classes_as_the_newest_chunk_says():
    policy = Chunked(Told(), 3, 0, 2, (1,))
    memory, plans = policy.initial_memory(jax.random.key(0)), RNG.normal(size=(5, 3, 2)).astype(np.float32)
    for plan in plans:
        action, memory = policy.act((), Observation(state=jnp.asarray(plan.ravel())), memory)
        assert action[1] == plan[0, 1]
    assert action[0] != plan[0, 0]
    made, indices = method(chunk=3)
    assert indices == (1, 3, 5)
    assert made.class_indices == (1,)
    assert made.method.class_indices == (1, 3, 5)


def test_data_sets_and_importers_name_the_entries(tmp_path):
    contents = Contents(None, 3, 2, action_names=("dx", "grip"))
    assert episodes.with_classes(contents, "grip").class_indices == (1,)
    assert episodes.with_classes(contents, "1,0").class_indices == (1, 0)
    with pytest.raises(ValueError, match="classes: got 'hand', expected some of dx, grip, or their indices"):
        episodes.with_classes(contents, "hand")
    with Writer(tmp_path / "set", None, 3, 2, class_indices=[1]) as writer:
        writer.add("a", "train", [50], [Demo(None, STATE, ACTION)])
    assert DataSet(tmp_path / "set").header.class_indices == (1,)
    with pytest.raises(ValueError, match=r"class_indices: got \(2,\), expected different indices below 2"):
        Writer(tmp_path / "other", None, 3, 2, class_indices=[2])
