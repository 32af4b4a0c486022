"""The policy network: what its parts promise the methods."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.networks.policy_network import PolicyConfig, make_policy

IMAGE_SHAPE, STATE, ACTION, GOAL, BATCH = (8, 10), 3, 2, 2, 6
TINY = {"filters": (4, 4), "strides": (2, 2), "fc_layers": (8,), "bias_transformation": 5}


@pytest.fixture(scope="module")
def inputs():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (BATCH, *IMAGE_SHAPE, 3), dtype=np.uint8)
    return jnp.asarray(image), jnp.asarray(rng.standard_normal((BATCH, STATE)))


def build(**changes):
    """Makes a tiny network, and parameters that are nowhere zero."""
    network = make_policy(PolicyConfig(**TINY | changes), IMAGE_SHAPE, STATE, ACTION, GOAL)
    leaves, tree = jax.tree.flatten(jax.jit(network.init)(jax.random.key(0)))
    rng = np.random.default_rng(1)
    network = network._replace(apply=jax.jit(network.apply))
    return network, jax.tree.unflatten(tree, [leaf + 0.3 * rng.standard_normal(leaf.shape) for leaf in leaves])


def with_layers(params, **layers):
    """Replaces the layers of the controller in the parameters."""
    return {**params, "controller": {**params["controller"], **layers}}


def test_bias_transformation_gives_the_first_bias_a_learned_step(inputs):
    """Compares with Section 4.1 of the paper: for z and its rows W of the first layer, z W + b is the layer's bias.

    A gradient step of rate alpha on (z, W) moves z W by -alpha g (W^T W + |z|^2) + O(alpha^2), where g is the loss's
    gradient by b: a step through a learned matrix, where b alone would move by -alpha g.
    """
    network, params = build()

    def loss(params):
        return jnp.sum(jnp.sin(network.apply(params, *inputs).action))

    gradient = jax.jit(jax.grad(loss))(params)
    z, W = params["bias_transformation"], params["controller"]["Dense_0"]["kernel"][-5:]
    slope = gradient["controller"]["Dense_0"]
    dz, dW, g = gradient["bias_transformation"], slope["kernel"][-5:], slope["bias"]
    assert np.count_nonzero(g) > 2
    np.testing.assert_allclose(dz, W @ g, atol=1e-12)
    np.testing.assert_allclose(dW, jnp.outer(z, g), atol=1e-12)

    alpha = 1e-3
    moved = (z - alpha * dz) @ (W - alpha * dW) - z @ W
    step = -alpha * (W.T @ W + z @ z * jnp.eye(len(g))) @ g
    second_order = alpha**2 * (dz @ dW)
    np.testing.assert_allclose(moved, step + second_order, atol=1e-14)

    # The network sees no more of (z, W_2) than that bias.
    first = params["controller"]["Dense_0"]
    folded = with_layers(params, Dense_0={**first, "bias": first["bias"] + z @ W})
    folded["bias_transformation"] = jnp.zeros(5)
    np.testing.assert_allclose(network.apply(folded, *inputs).action, network.apply(params, *inputs).action, rtol=1e-12)


def test_without_bias_transformation_nothing_of_it_is_left(inputs):
    network, params = build(bias_transformation=0)
    wide, wide_params = build()
    first = params["controller"]["Dense_0"]
    assert wide_params["controller"]["Dense_0"]["kernel"].shape[0] - first["kernel"].shape[0] == 5
    # A zero vector is as good as none.
    widened = {**first, "kernel": jnp.concatenate([first["kernel"], jnp.ones((5, 8))])}
    wide_params = {**with_layers(params, Dense_0=widened), "bias_transformation": jnp.zeros(5)}
    np.testing.assert_allclose(wide.apply(wide_params, *inputs).action, network.apply(params, *inputs).action)


@pytest.mark.parametrize("changes", [{}, {"soft_argmax": True, "goal_head": True}])
def test_examples_of_a_batch_do_not_see_each_other(inputs, changes):
    """Compares a batch with a loop over its examples: layer norm, unlike batch norm, acts within an example."""
    network, params = build(**changes)

    def answer(*inputs):
        output = network.apply(params, *inputs)
        return (output.action, output.goal.log_weight) if output.goal else (output.action,)

    together = answer(*inputs)
    for i in range(BATCH):
        alone = answer(*(x[i : i + 1] for x in inputs))
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[0], b[i], rtol=1e-9), alone, together)
    for parts in together:
        assert np.abs(np.diff(parts, axis=0)).min() > 1e-6


def test_one_head_answers_both_losses(inputs):
    network, params = build()
    output = network.apply(params, *inputs)
    np.testing.assert_array_equal(output.action, output.inner_action)


@pytest.mark.parametrize(
    ("changes", "acting", "inner"),
    [({"heads": 2}, "Dense_2", "Dense_1"), ({"inner_first_layer": True}, "Dense_0", "inner_first")],
    ids=["two heads", "two first layers"],
)
def test_the_two_losses_share_all_but_one_layer(inputs, changes, acting, inner):
    network, params = build(**changes)
    output, layers = network.apply(params, *inputs), params["controller"]
    swapped = with_layers(params, **{inner: layers[acting], acting: layers[inner]})
    np.testing.assert_array_equal(network.apply(swapped, *inputs).action, output.inner_action)
    np.testing.assert_array_equal(network.apply(swapped, *inputs).inner_action, output.action)
    assert np.abs(output.action - output.inner_action).min() > 1e-6


def test_the_prediction_of_the_goal_reaches_the_action(inputs):
    network, params = build(goal_head=True)
    head, first = params["controller"]["goal_head"], params["controller"]["Dense_0"]
    # The expected goal is appended to the input of the first layer: a shift of all votes acts through its rows.
    shift = jnp.array([0.3, -0.7])
    moved = with_layers(params, goal_head={**head, "vote": head["vote"].at[-1].add(shift)})
    folded = with_layers(params, Dense_0={**first, "bias": first["bias"] + shift @ first["kernel"][-GOAL:]})
    plain, moved, folded = (network.apply(p, *inputs) for p in (params, moved, folded))
    np.testing.assert_allclose(moved.goal.mean, plain.goal.mean + shift, rtol=1e-9)
    np.testing.assert_allclose(moved.action, folded.action, rtol=1e-9)
    assert np.abs(moved.action - plain.action).max() > 1e-3


@pytest.mark.slow
def test_the_first_image_of_an_episode_tells_the_target_of_all_its_steps(inputs):
    network, params = build(target_head=True)
    image, state = inputs
    alone, episodes = network.apply(params, image, state), network.apply.__wrapped__(params, image, state, 3)
    np.testing.assert_allclose(episodes.target, np.repeat(alone.target[::3], 3, axis=0), rtol=1e-9)
    # A target that is known already takes the place of what the image tells, and reaches the action.
    given = network.apply.__wrapped__(params, image, state, 1, episodes.target.at[::3].set(jnp.nan))
    np.testing.assert_allclose(given.action, episodes.action, rtol=1e-9)
    assert np.abs(alone.action - episodes.action)[np.arange(len(state)) % 3 > 0].min() > 1e-6
