"""MIL's meta-gradient against finite differences and closed forms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from mil_cases import (
    ALPHA,
    SLOPE,
    THETA,
    M,
    assert_trees_close,
    build,
    constant_mil,
    difference,
    random_batch,
    random_whitening,
)

from milx.types import TaskBatch


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def batch(float64):
    return random_batch()


# The meta-gradient of the tiny network.

VARIANTS = {
    "one step": (None, {}),
    "two steps, clipped": (None, {"inner_steps": 2, "inner_clip": 0.1, "loss_scale": 3.0, "inner_lr": 0.02}),
    "two steps, two heads, goal, learned rates": (
        {"heads": 2, "goal_head": True, "soft_argmax": True},
        {"inner_steps": 2, "learn_inner_lr": True, "goal_weight": 0.7},
    ),
    "learned loss of states": (
        {"learned_loss": "linear", "goal_head": True},
        {"given": "video+state", "goal_weight": 0.7},
    ),
    "hindsight, unadapted": (
        {"learned_loss": "linear", "goal_head": True, "hindsight_head": True},
        {"given": "video", "goal_weight": 0.7, "inner_lr": 0.0},
    ),
    "target head, two steps": ({"target_head": True, "soft_argmax": True}, {"inner_steps": 2, "goal_weight": 0.7}),
    "learned loss of video, a first layer of its own": (
        {"learned_loss": "linear", "heads": 2, "inner_first_layer": True},
        {"given": "video"},
    ),
    "learned loss over time, two steps": ({"learned_loss": "temporal"}, {"given": "video", "inner_steps": 2}),
}


SLOW = ("two steps, two heads, goal, learned rates", "learned loss over time, two steps")
assert set(SLOW) < set(VARIANTS)


@pytest.mark.parametrize(
    "variant", [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in VARIANTS]
)
def test_meta_gradient_is_that_of_finite_differences(batch, variant):
    network, config = VARIANTS[variant]
    method, params = build(network, **config)
    loss = jax.jit(jax.value_and_grad(lambda params: method.loss(params, batch)[0]))
    _, gradient = loss(params)
    if config.get("inner_clip"):
        inner, _ = jax.jit(jax.grad(method.imitation_loss, has_aux=True))(
            params["policy"], params["whitening"], jax.tree.map(lambda x: x[0], batch.support)
        )
        clipped = np.abs(jax.flatten_util.ravel_pytree(inner)[0]) > config["inner_clip"]
        assert 0.05 < clipped.mean() < 0.95

    learned = {name: value for name, value in params.items() if name != "whitening"}
    rng, epsilon = np.random.default_rng(3), 1e-6
    for name in [*learned, *learned, *learned]:
        direction = jax.tree.map(lambda x: rng.standard_normal(x.shape), learned[name])

        def shifted(by, name=name, direction=direction):
            return loss({**params, name: jax.tree.map(lambda x, d: x + by * d, params[name], direction)})[0]

        slope = (shifted(epsilon) - shifted(-epsilon)) / (2 * epsilon)
        expected = sum(jax.tree.leaves(jax.tree.map(np.vdot, gradient[name], direction)))
        assert abs(slope) > 1e-4
        np.testing.assert_allclose(expected, slope, rtol=1e-5, err_msg=name)


def test_first_order_gradient_is_the_query_gradient_at_the_adapted_parameters(batch):
    method, params = build(inner_steps=2, first_order=True, learn_inner_lr=True)
    full, _ = build(inner_steps=2, learn_inner_lr=True)

    def query_gradient(support, query):
        adapted = method.adapt(params, support)
        return jax.grad(method.imitation_loss, has_aux=True)(adapted["policy"], adapted["whitening"], query)[0]

    expected = jax.tree.map(lambda g: g.mean(axis=0), jax.jit(jax.vmap(query_gradient))(batch.support, batch.query))
    gradient, second_order = (
        jax.jit(jax.grad(lambda params, m=m: m.loss(params, batch)[0]))(params) for m in (method, full)
    )
    assert_trees_close(gradient["policy"], expected)
    norm = jax.jit(optax.tree.norm)
    change = norm(difference(second_order["policy"], expected)) / norm(expected)
    assert change > 0.01, "second derivatives matter here"


def test_no_gradient_reaches_the_whitening_and_adam_leaves_it(batch):
    method, params = build()
    gradient = jax.jit(jax.grad(lambda params: method.loss(params, batch)[0]))(params)
    assert optax.tree.norm(gradient["policy"]) > 0.01
    optimizer = optax.adam(1e-3)
    updates, _ = jax.jit(optimizer.update)(gradient, jax.jit(optimizer.init)(params), params)
    after = optax.apply_updates(params, updates)
    for name, value in dataclasses.asdict(params["whitening"]).items():
        np.testing.assert_array_equal(getattr(gradient["whitening"], name), 0)
        np.testing.assert_array_equal(getattr(after["whitening"], name), value)


@pytest.fixture(scope="module")
def constant_case(batch):
    """Makes parameters, a batch without images, and the mean whitened actions of support and query [TASKS, A]."""
    whitening = random_whitening(np.random.default_rng(4))
    support, query = (dataclasses.replace(demo, image=None) for demo in (batch.support, batch.query))
    a, b = ((x.action.mean(axis=(1, 2)) - whitening.action_mean) / whitening.action_scale for x in (support, query))
    params = {"policy": jnp.asarray(THETA), "whitening": whitening}
    return params, TaskBatch(support, query), np.asarray(a), np.asarray(b)


@pytest.mark.parametrize("steps", [1, 2, 5])
@pytest.mark.parametrize("first_order", [False, True])
def test_closed_form_of_the_meta_gradient(constant_case, steps, first_order):
    params, batch, a, b = constant_case
    method = constant_mil(inner_steps=steps, first_order=first_order)
    shrink = (1 - ALPHA * SLOPE) ** steps
    adapted = a + shrink * (THETA - a)
    one = jax.tree.map(lambda x: x[0], batch.support)
    np.testing.assert_allclose(method.adapt(params, one)["policy"], adapted[0], rtol=1e-12)

    (loss, metrics), gradient = jax.jit(jax.value_and_grad(method.loss, has_aux=True))(params, batch)
    action = params["whitening"].action(np.asarray(batch.query.action))
    expected = np.mean(M**2 * (adapted[:, None, None] - action) ** 2)
    np.testing.assert_allclose(loss, expected, rtol=1e-12)
    np.testing.assert_allclose(np.mean(metrics["action_loss"]), expected, rtol=1e-12)
    factor = 1 if first_order else shrink
    np.testing.assert_allclose(gradient["policy"], factor * SLOPE * (adapted - b).mean(axis=0), rtol=1e-11)


@pytest.mark.parametrize("first_order", [False, True])
def test_closed_form_of_the_learned_rates_gradient(constant_case, first_order):
    params, batch, a, b = constant_case
    s = 0.3
    params = {**params, "inner_log_lr": jnp.asarray(s)}
    method = constant_mil(learn_inner_lr=True, first_order=first_order)
    step = -ALPHA * np.exp(s) * SLOPE * (THETA - a)
    gradient = jax.grad(lambda params: method.loss(params, batch)[0])(params)
    expected = np.mean(np.sum(SLOPE * (THETA + step - b) * step, axis=-1))
    np.testing.assert_allclose(gradient["inner_log_lr"], expected, rtol=1e-11)


def test_closed_form_of_the_clipped_step(constant_case):
    """Expects a factor of one where the clip holds: the step is alpha times the clip and does not depend on theta."""
    params, batch, a, b = constant_case
    inner = SLOPE * (THETA - a)
    clip = float(np.median(np.abs(inner)))
    method = constant_mil(inner_clip=clip)
    held = np.abs(inner) > clip
    assert held.sum() == held.size / 2
    adapted = np.where(held, THETA - ALPHA * clip * np.sign(inner), THETA - ALPHA * inner)
    found = jax.vmap(lambda support: method.adapt(params, support)["policy"])(batch.support)
    np.testing.assert_allclose(found, adapted, rtol=1e-12)
    gradient = jax.grad(lambda params: method.loss(params, batch)[0])(params)
    expected = np.where(held, 1, 1 - ALPHA * SLOPE) * SLOPE * (adapted - b)
    np.testing.assert_allclose(gradient["policy"], expected.mean(axis=0), rtol=1e-11)


@pytest.mark.slow
def test_an_adapted_policy_is_sharpened_and_the_meta_objective_is_not(batch):
    plain, params = build({"goal_head": True, "soft_argmax": True}, goal_weight=0.7)
    sharp, _ = build({"goal_head": True, "soft_argmax": True}, goal_weight=0.7, sharpness=4.0)
    support = jax.tree.map(lambda x: x[0], batch.support)
    adapted = (jax.jit(method.adapt)(params, support) for method in (plain, sharp))
    before, after = (task_params["policy"]["controller"]["goal_head"] for task_params in adapted)
    np.testing.assert_allclose(after["kernel"], 4 * before["kernel"], rtol=1e-12)
    np.testing.assert_array_equal(after["vote"], before["vote"])
    losses = [jax.jit(method.loss)(params, batch)[0] for method in (plain, sharp)]
    np.testing.assert_allclose(*losses, rtol=1e-12)
