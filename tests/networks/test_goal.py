"""The goal's density against SciPy, and the law that makes one inner step find what was shown."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import softmax
from scipy.stats import multivariate_normal

from milx.networks.goal import Goal, GoalHead, HindsightHead, StateGoalHead, sharpen
from milx.networks.layers import positions

BATCH, HEIGHT, WIDTH, CHANNELS, GOAL = 5, 3, 4, 6, 2
LOG_STD = -0.4


def likelihoods(weight, vote, goal):
    """Computes [B, P], every position's share of the density of every goal, by SciPy."""
    normal = [multivariate_normal(mean, np.exp(2 * LOG_STD)) for mean in vote]
    return weight * np.stack([n.pdf(goal) for n in normal], axis=-1)


def test_density_is_that_of_a_mixture_of_gaussians(rng):
    heat, vote, goal = (rng.standard_normal(shape) for shape in ((BATCH, 7), (7, GOAL), (BATCH, GOAL)))
    density = Goal(jax.nn.log_softmax(heat), jnp.asarray(vote), jnp.asarray(LOG_STD))
    weight = softmax(heat, axis=-1)
    expected = -np.log(likelihoods(weight, vote, goal).sum(axis=-1))
    np.testing.assert_allclose(density.negative_log_likelihood(jnp.asarray(goal)), expected, rtol=1e-12)
    np.testing.assert_allclose(density.mean, weight @ vote, rtol=1e-12)


def test_gradient_in_the_filter_is_the_mean_feature_less_the_feature_where_the_goal_is(rng):
    features, goal = rng.standard_normal((BATCH, HEIGHT, WIDTH, CHANNELS)), rng.standard_normal((BATCH, GOAL))
    head = GoalHead(GOAL)
    params = jax.tree.map(lambda x: jnp.asarray(rng.standard_normal(x.shape)), head.init(jax.random.key(0), features))
    params["params"]["log_std"] = jnp.asarray(LOG_STD)

    def loss(params):
        return head.apply(params, features).negative_log_likelihood(jnp.asarray(goal)).sum()

    gradient = jax.jit(jax.grad(loss))(params)["params"]["kernel"]
    found = jax.jit(head.apply)(params, features)
    prior = np.exp(found.log_weight)
    posterior = likelihoods(prior, np.asarray(found.vote), goal)
    posterior /= posterior.sum(axis=-1, keepdims=True)
    expected = np.einsum("bp,bpc->c", prior - posterior, features.reshape(BATCH, -1, CHANNELS))
    np.testing.assert_allclose(gradient, expected, rtol=1e-10)
    assert np.abs(expected).min() > 1e-2


def test_gradient_in_the_weights_of_states_votes_is_their_prior_less_their_posterior(rng):
    """Gives each state its own votes and all states the same weights; a step favors what was near."""
    state, goal = rng.standard_normal((BATCH, 7)), rng.standard_normal((BATCH, GOAL))
    head = StateGoalHead(GOAL)
    params = head.init(jax.random.key(0), jnp.asarray(state))["params"]
    params = {**params, "log_std": jnp.asarray(LOG_STD)}

    def loss(heat):
        found = head.apply({"params": {**params, "heat": heat}}, jnp.asarray(state))
        return found.negative_log_likelihood(jnp.asarray(goal)).sum()

    kernel, bias = (np.asarray(params["vote"][name]) for name in ("kernel", "bias"))
    votes = np.einsum("bs,spg->bpg", state, kernel) + bias
    heat = rng.standard_normal(head.candidates)
    prior = softmax(heat)
    likelihood = np.stack([likelihoods(prior, vote, goal[i]) for i, vote in enumerate(votes)])
    np.testing.assert_allclose(loss(jnp.asarray(heat)), -np.log(likelihood.sum(axis=-1)).sum(), rtol=1e-10)
    posterior = likelihood / likelihood.sum(axis=-1, keepdims=True)
    np.testing.assert_allclose(jax.grad(loss)(jnp.asarray(heat)), (prior - posterior).sum(axis=0), rtol=1e-10)


def test_votes_are_affine_in_the_position_and_the_weights_follow_the_features(rng):
    head, spot = GoalHead(GOAL), (2, 1)
    features = np.zeros((1, HEIGHT, WIDTH, CHANNELS))
    features[0, *spot] = 1.0
    params = {
        "kernel": jnp.full(CHANNELS, 9.0),
        "vote": jnp.asarray(rng.standard_normal((3, GOAL))),
        "log_std": jnp.zeros(()),
    }
    found = head.apply({"params": params}, jnp.asarray(features))
    x, y = 2 * spot[1] / (WIDTH - 1) - 1, 2 * spot[0] / (HEIGHT - 1) - 1
    np.testing.assert_allclose(positions(HEIGHT, WIDTH)[spot[0] * WIDTH + spot[1]], [x, y], rtol=1e-12)
    x, y = (2 * spot[1] + 1) / WIDTH - 1, (2 * spot[0] + 1) / HEIGHT - 1  # the cell's center in the image
    # e^54 against eleven positions without features.
    np.testing.assert_allclose(found.mean[0], np.array([x, y, 1.0]) @ params["vote"], rtol=1e-12)


def test_hindsight_is_where_the_first_image_differs_from_the_last(rng):
    """Sets filters that subtract one image from the other: they find the place that lost its features."""
    units = HindsightHead.hidden
    seen = rng.uniform(size=(1, 3, HEIGHT, WIDTH, CHANNELS))
    seen[0, -1] = seen[0, 0]
    seen[0, -1, 2, 1] -= 1.0
    minus = np.eye(CHANNELS, units)
    vote = rng.standard_normal((3, GOAL))
    params = {
        "Dense_0": {"kernel": np.concatenate([minus, -minus]), "bias": np.zeros(units)},
        "goal_head": {"kernel": np.full(units, 50.0), "vote": vote, "log_std": np.zeros(())},
    }
    found = HindsightHead(GOAL).apply({"params": params}, jnp.asarray(seen))
    where = np.array([3 / WIDTH - 1, 5 / HEIGHT - 1, 1.0])
    np.testing.assert_allclose(found.mean[0], where @ vote, rtol=1e-9)


HEADS = {"image": (GoalHead(GOAL), (BATCH, HEIGHT, WIDTH, CHANNELS)), "state": (StateGoalHead(GOAL), (BATCH, 7))}


@pytest.mark.parametrize("name", HEADS)
def test_sharpened_weights_are_their_power_and_the_votes_stay(rng, name):
    head, shape = HEADS[name]
    seen = jnp.asarray(rng.standard_normal(shape))
    params = head.init(jax.random.key(0), seen)["params"]
    params = jax.tree.map(lambda x: jnp.asarray(rng.standard_normal(x.shape)), params)
    before, after = (head.apply({"params": p}, seen) for p in (params, sharpen(params, 3.0)))
    cubed = np.exp(before.log_weight) ** 3
    np.testing.assert_allclose(np.exp(after.log_weight), cubed / cubed.sum(axis=-1, keepdims=True), rtol=1e-9)
    np.testing.assert_array_equal(after.vote, before.vote)
