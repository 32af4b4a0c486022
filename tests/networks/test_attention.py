"""What the attentive policy looks at."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.networks.attention import AttentionConfig, AttentiveActor, ObjectTokens, separate_objects

STATE, ACTION, STEPS, BATCH = 7, 2, 5, 4
OBJECTS = ((1, 2), (5, 6), (3, 4))
CONFIG = AttentionConfig(fc_layers=(16,), context=8)


@pytest.fixture(scope="module")
def networks():
    encoder, actor = ObjectTokens(CONFIG, OBJECTS), AttentiveActor(CONFIG, ACTION, OBJECTS)
    tokens, encoding = encoder.init_with_output(jax.random.key(0), None, jnp.zeros((1, STATE)), jnp.zeros((1, ACTION)))
    acting = jax.jit(actor.init)(jax.random.key(1), tokens, None, jnp.zeros((1, STATE)))["params"]

    @jax.jit
    def attend(state, action, seen):
        tokens = encoder.apply(encoding, None, state, action)
        output, sown = actor.apply({"params": acting}, tokens, None, seen, mutable="intermediates")
        return output.action, sown["intermediates"]

    return attend


@pytest.fixture
def demo(rng):
    return jnp.asarray(rng.standard_normal((STEPS, STATE))), jnp.asarray(rng.standard_normal((STEPS, ACTION)))


def test_states_are_split_into_objects_and_the_rest():
    places, rest = separate_objects(jnp.arange(2 * STATE).reshape(2, STATE), OBJECTS)
    np.testing.assert_array_equal(places[1], [[8, 9], [12, 13], [10, 11]])
    np.testing.assert_array_equal(rest, [[0], [7]])


def test_attention_is_a_distribution_that_the_demonstration_moves(networks, demo, rng):
    seen = jnp.asarray(rng.standard_normal((BATCH, STATE)))
    _, weights = networks(*demo, seen)
    assert [w.shape for w in weights["time"]] == [(BATCH, STEPS, 3)] * 2
    for name, axis in (("time", 1), ("object", 1)):
        for w in weights[name]:
            np.testing.assert_allclose(w.sum(axis=axis), 1, atol=1e-12)
            assert w.min() > 0
    _, other = networks(demo[0] + 1, demo[1], seen)
    for name in ("time", "object"):
        change = [float(jnp.abs(a - b).max()) for a, b in zip(weights[name], other[name], strict=True)]
        assert min(change) > 1e-4, name


def test_a_demonstration_has_an_order_in_time(networks, demo, rng):
    seen = jnp.asarray(rng.standard_normal((BATCH, STATE)))
    action, _ = networks(*demo, seen)
    backwards, _ = networks(demo[0][::-1], demo[1][::-1], seen)
    assert jnp.abs(backwards - action).min() > 1e-5


def test_what_is_read_does_not_depend_on_the_other_observations(networks, demo, rng):
    seen = jnp.asarray(rng.standard_normal((BATCH, STATE)))
    together, _ = networks(*demo, seen)
    for i in range(BATCH):
        alone, _ = networks(*demo, seen[i : i + 1])
        np.testing.assert_allclose(alone[0], together[i], atol=1e-12)
