"""Inner steps and their derivatives, against closed forms, loops and finite differences, in double precision."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from milx import meta
from milx.meta import ORDERS

SECOND = ORDERS[:2]


RNG = np.random.default_rng(0)
ROOT = RNG.normal(size=(4, 4))
MATRIX = ROOT @ ROOT.T / 4 + np.eye(4)
START, CENTER, OTHER = RNG.normal(size=(3, 4))
RATE = 0.1


def bowl(theta, center):
    """A quadratic loss, whose gradient is MATRIX (theta - center)."""
    return 0.5 * (theta - center) @ MATRIX @ (theta - center)


def curved(params, x, y):
    """The squared error of a small network, of a plain dictionary."""
    hidden = jnp.tanh(x @ params["first"]["kernel"] + params["first"]["bias"])
    return jnp.mean(jnp.square(hidden @ params["last"] - y))


def network():
    rng = np.random.default_rng(1)
    shapes = {"first": {"kernel": (3, 5), "bias": (5,)}, "last": (5, 2)}
    params = jax.tree.map(lambda shape: jnp.asarray(rng.normal(size=shape)), shapes, is_leaf=lambda x: type(x) is tuple)
    return params, *(jnp.asarray(rng.normal(size=(2, 7, size))) for size in (3, 2))


@pytest.mark.parametrize("steps", [0, 1, 3])
def test_steps_on_a_bowl_are_powers_of_a_matrix(steps):
    """theta_K = c + (I - alpha A)^K (theta - c)."""
    shrink = np.linalg.matrix_power(np.eye(4) - RATE * MATRIX, steps)
    found = meta.adapt(bowl, START, CENTER, steps=steps, rate=RATE)
    np.testing.assert_allclose(found, CENTER + shrink @ (START - CENTER), rtol=1e-12)


@pytest.mark.parametrize("steps", [1, 3])
@pytest.mark.parametrize("order", ORDERS)
def test_the_derivative_of_steps_on_a_bowl_is_that_power_or_one(order, steps):
    shrink = np.linalg.matrix_power(np.eye(4) - RATE * MATRIX, steps) if order in SECOND else np.eye(4)

    def query(theta):
        return bowl(meta.adapt(bowl, theta, CENTER, steps=steps, rate=RATE, order=order), OTHER)

    adapted = meta.adapt(bowl, START, CENTER, steps=steps, rate=RATE)
    np.testing.assert_allclose(jax.grad(query)(START), shrink.T @ MATRIX @ (adapted - OTHER), rtol=1e-10)


@pytest.mark.parametrize("order", SECOND)
def test_the_meta_gradient_agrees_with_finite_differences(order):
    """In a random direction, also of the rates, which are of every tensor and step."""
    params, x, y = network()
    rates = jax.tree.map(lambda p: jnp.asarray(RNG.uniform(0.05, 0.3, 2)), params)

    def query(both):
        params, rates = both
        adapted = meta.adapt(curved, params, x[0], y[0], steps=2, rate=rates, clip=0.5, order=order)
        return curved(adapted, x[1], y[1])

    direction = jax.tree.map(lambda p: jnp.asarray(RNG.normal(size=p.shape)), (params, rates))
    found = jax.tree.map(lambda g, d: jnp.sum(g * d), jax.grad(query)((params, rates)), direction)
    moved = [jax.tree.map(lambda p, d, h=h: p + h * d, (params, rates), direction) for h in (1e-5, -1e-5)]
    expected = (query(moved[0]) - query(moved[1])) / 2e-5
    np.testing.assert_allclose(sum(jax.tree.leaves(found)), expected, rtol=1e-7)


def test_rates_masks_and_bounds_are_those_of_a_loop():
    params, x, y = network()
    rates = {"first": RNG.uniform(0.1, 2, 3), "last": RNG.uniform(0.1, 2)}
    mask = {"first": {"kernel": True, "bias": False}, "last": True}
    bounds = 0.05
    path = meta.adapt(curved, params, x[0], y[0], steps=3, rate=rates, clip=bounds, mask=mask, path=True)
    now = params
    for k in range(3):
        g = jax.grad(curved)(now, x[0], y[0])
        step = jax.tree.map(lambda g: np.clip(g, -bounds, bounds), g)
        now = {
            "first": {
                "kernel": now["first"]["kernel"] - rates["first"][k] * step["first"]["kernel"],
                "bias": now["first"]["bias"],
            },
            "last": now["last"] - rates["last"] * step["last"],
        }
        jax.tree.map(lambda a, b, k=k: np.testing.assert_allclose(a[k], b, rtol=1e-12), path, now)
        assert max(float(np.abs(leaf).max()) for leaf in jax.tree.leaves(g)) > bounds
    last = meta.adapt(curved, params, x[0], y[0], steps=3, rate=rates, clip=bounds, mask=mask)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), last, now)


def test_what_a_mask_keeps_learns_from_the_query_alone():
    """The Hessian does not reach a tensor that is kept, but what it does to the others does."""
    params, x, y = network()
    mask = {"first": False, "last": True}

    def query(params):
        adapted = meta.adapt(curved, params, x[0], y[0], steps=1, rate=0.3, mask=mask)
        return curved(adapted, x[1], y[1])

    def by_hand(params):
        last = params["last"] - 0.3 * jax.grad(curved)(params, x[0], y[0])["last"]
        return curved({"first": params["first"], "last": last}, x[1], y[1])

    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10), jax.grad(query)(params), jax.grad(by_hand)(params)
    )


def test_parameters_of_flax_are_adapted_as_those_of_a_dictionary():
    x, y = network()[1:]
    dense = nn.Dense(2)
    linen = dense.init(jax.random.key(0), x[0])
    square = lambda predicted, y: jnp.mean(jnp.square(predicted - y))  # noqa: E731
    of_linen = meta.adapt(lambda p, x, y: square(dense.apply(p, x), y), linen, x[0], y[0], steps=2, rate=0.1)
    plain = lambda p, x, y: square(x @ p["kernel"] + p["bias"], y)  # noqa: E731
    expected = meta.adapt(plain, linen["params"], x[0], y[0], steps=2, rate=0.1)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), of_linen["params"], expected)

    graph, state = nnx.split(nnx.Linear(3, 2, rngs=nnx.Rngs(0), param_dtype=jnp.float64))
    nnx.update(state, nnx.State({"kernel": linen["params"]["kernel"], "bias": linen["params"]["bias"]}))
    of_nnx = meta.adapt(lambda p, x, y: square(nnx.merge(graph, p)(x), y), state, x[0], y[0], steps=2, rate=0.1)
    flat = {path[-1].key: leaf for path, leaf in jax.tree_util.tree_leaves_with_path(of_nnx, is_leaf=_is_variable)}
    for name, values in expected.items():
        np.testing.assert_allclose(jax.tree.leaves(flat[name])[0], values, rtol=1e-12)


def _is_variable(value):
    return isinstance(value, nnx.Variable)


@pytest.mark.parametrize("steps", [0, 1, 2])
def test_steps_keep_the_types_of_parameters(steps):
    params = {"half": jnp.asarray(START, jnp.bfloat16), "single": np.float32(START), "double": 1.5}
    square = lambda params: sum(jnp.sum(x.astype(float) ** 2) for x in jax.tree.leaves(params))  # noqa: E731
    found = meta.adapt(square, params, steps=steps, rate=jnp.float32(0.25))
    for name, dtype in (("half", jnp.bfloat16), ("single", np.float32), ("double", np.float64)):
        assert found[name].dtype == dtype
        np.testing.assert_allclose(
            np.asarray(found[name], float), 0.5**steps * np.asarray(params[name], float), rtol=2e-2
        )


@pytest.mark.parametrize("steps", [0, 1, 2])
def test_a_path_has_the_parameters_after_every_step(steps):
    found = meta.adapt(bowl, START, CENTER, steps=steps, rate=RATE, path=True)
    each = [meta.adapt(bowl, START, CENTER, steps=k, rate=RATE) for k in range(1, steps + 1)]
    np.testing.assert_allclose(found, np.reshape(each, (steps, 4)), rtol=1e-12)


@pytest.mark.parametrize("path", [False, True])
@pytest.mark.parametrize(("unroll", "loops"), [(2, True), (3, False), (5, False)])
def test_unrolled_steps_are_the_same_and_leave_no_loop_if_all_are(path, unroll, loops):
    """Compares three steps and their derivative with those of a scan, in which XLA sees a loop."""

    def adapted(theta, unroll):
        return meta.adapt(bowl, theta, CENTER, steps=3, rate=RATE, path=path, unroll=unroll)

    derivative = jax.jit(jax.jacrev(adapted), static_argnums=1)
    looped, unrolled = derivative.lower(START, 1), derivative.lower(START, unroll)
    assert "stablehlo.while" in looped.as_text()
    assert ("stablehlo.while" in unrolled.as_text()) == loops
    np.testing.assert_allclose(adapted(START, unroll), adapted(START, 1), rtol=1e-12)
    np.testing.assert_allclose(unrolled.compile()(START), looped.compile()(START), rtol=1e-12)


@pytest.mark.parametrize("order", ORDERS)
def test_only_reverse_over_reverse_differentiates_by_data(order):
    adapted = lambda center: meta.adapt(bowl, START, center, steps=1, rate=RATE, order=order).sum()  # noqa: E731
    expected = RATE * MATRIX.sum(axis=0) if order == "reverse_over_reverse" else np.zeros(4)
    np.testing.assert_allclose(jax.grad(adapted)(CENTER), expected, rtol=1e-12)


def test_forward_over_reverse_keeps_nothing_of_the_inner_step():
    """Adds up what is kept for the backward pass: parameters, data and results, and otherwise activations, too."""
    params, x, y = network()
    x, y = (jnp.tile(a[0], (100, 1)) for a in (x, y))
    kept = {}
    for order in SECOND:
        pull = jax.vjp(lambda p, order=order: meta.adapt(curved, p, x, y, steps=1, rate=0.1, order=order), params)[1]
        kept[order] = sum(leaf.size for leaf in jax.tree.leaves(pull))
    inputs = sum(leaf.size for leaf in jax.tree.leaves((params, x, y)))
    assert kept["forward_over_reverse"] <= inputs + 2 * len(jax.tree.leaves(params))
    assert kept["reverse_over_reverse"] > 2 * inputs


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"steps": -1, "rate": 0.1}, "steps: got -1, expected at least 0"),
        ({"steps": 2, "rate": 0.1, "unroll": 0}, "unroll: got 0, expected at least 1"),
        ({"steps": 2, "rate": np.ones(3)}, r"rate: got the shape \(3,\), expected a scalar or 2 steps"),
        ({"steps": 1, "rate": 0.1, "order": "second"}, "order: got 'second', expected one of forward_over_reverse, "),
        (
            {"steps": 1, "rate": {"first": 0.1}},
            r"rate: got PyTreeDef\(\{'first': \*\}\), expected one value, or the structure",
        ),
        ({"steps": 1, "rate": 0.1, "mask": {"first": 1, "last": True}}, "mask: got 1, expected True or False"),
        ({"steps": 1, "rate": 0.1, "mask": [True]}, r"mask: got PyTreeDef\(\[\*\]\), expected one value"),
        ({"steps": 1, "rate": 0.1, "clip": -1.0}, "clip: got -1.0, expected at least 0, or None"),
    ],
)
def test_settings_that_do_not_fit_are_refused(settings, message):
    params, x, y = network()
    with pytest.raises(ValueError, match=message):
        meta.adapt(curved, params, x[0], y[0], **settings)


def test_a_rate_of_one_step_is_a_scalar():
    with pytest.raises(ValueError, match=r"rate: got the shape \(4,\), expected a scalar"):
        meta.inner_step(bowl, START, CENTER, rate=np.ones(4))
