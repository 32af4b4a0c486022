"""The learned loss in closed form, and what it can tell apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.networks.learned_loss import LearnedLoss

DEMOS, STEPS, FEATURES = 3, 12, 5


def build(kind, rng):
    features = jnp.asarray(rng.standard_normal((DEMOS, STEPS, FEATURES)))
    module = LearnedLoss(kind)
    start = module.init(jax.random.key(0), features)
    params = jax.tree.map(lambda x: x + 0.1 * rng.standard_normal(x.shape), start)
    return jax.jit(lambda features: module.apply(params, features)), params["params"], features


def test_linear_loss_is_the_mean_square_of_an_affine_function(rng):
    loss, params, features = build("linear", rng)
    affine = np.asarray(features) @ np.asarray(params["Dense_0"]["kernel"]) + np.asarray(params["Dense_0"]["bias"])
    np.testing.assert_allclose(loss(features), (affine**2).mean(axis=(1, 2)), rtol=1e-10)


@pytest.mark.parametrize(("kind", "ordered"), [("linear", False), ("temporal", True)])
def test_only_the_temporal_loss_knows_the_order_of_time(kind, ordered, rng):
    loss, _, features = build(kind, rng)
    before, after = loss(features), loss(features[:, ::-1])
    assert (np.abs(np.asarray(before - after)).min() > 1e-4) == ordered


@pytest.mark.parametrize("kind", ["linear", "temporal"])
def test_demonstrations_do_not_see_each_other(kind, rng):
    loss, _, features = build(kind, rng)
    together = loss(features)
    np.testing.assert_allclose(together, [loss(features[k : k + 1])[0] for k in range(DEMOS)], rtol=1e-9)
    assert np.ptp(np.asarray(together)) > 1e-4
