"""The meta-optimizer: what it does to a constant gradient is minus the learning rate; and programs that compile."""

import dataclasses
import functools
import re
import threading
import types

import jax.numpy as jnp
import numpy as np
import optax
import pytest

from milx.config.assemble import make_config
from milx.config.registry import PRESETS
from milx.config.schema import OptimizerConfig
from milx.training.update import Trainer, compile_in_background, make_optimizer

STEPS = 40


def rates(config, gradient=1.0):
    """Measures learning rates: Adam moves a parameter with a constant gradient by them, whatever the gradient is."""
    optimizer = make_optimizer(config, STEPS)
    state, moved = optimizer.init(jnp.zeros(())), []
    for _ in range(STEPS):
        update, state = optimizer.update(jnp.asarray(gradient), state)
        moved.append(-float(update))
    return np.array(moved)


@pytest.mark.parametrize("warmup", [0.0, 0.25])
@pytest.mark.parametrize("cosine", [False, True])
def test_schedule(warmup, cosine):
    config = OptimizerConfig(learning_rate=3e-3, warmup=warmup, cosine=cosine)
    t, first = np.arange(STEPS), round(warmup * STEPS)
    after = 0.5 * (1 + np.cos(np.pi * (t - first) / (STEPS - first))) if cosine else np.ones(STEPS)
    expected = 3e-3 * np.where(t < first, t / max(first, 1), after)
    np.testing.assert_allclose(rates(config), expected, rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize("preset", PRESETS["reach"])
def test_every_preset_learns(preset):
    config = dataclasses.replace(make_config("reach", preset=preset).optimizer, name="adam")
    assert rates(config).max() == pytest.approx(config.learning_rate, rel=1e-3)


def test_the_global_norm_is_clipped():
    clipped = make_optimizer(OptimizerConfig(clip_norm=1.0), STEPS)
    update, state = clipped.update(jnp.array([3.0, 4.0]), clipped.init(jnp.zeros(2)))
    first_moment = optax.tree.get(state, "mu")
    np.testing.assert_allclose(first_moment, 0.1 * np.array([0.6, 0.8]), rtol=1e-5)
    assert update.shape == (2,)


@pytest.mark.parametrize("shape", [(288, 32), (20, 50), (3, 3, 8, 16)])
def test_muon_moves_a_kernel_by_an_orthogonal_matrix_near_its_gradient(shape):
    """Compares with U V^T of the singular value decomposition G = U S V^T, scaled to a root mean square of 0.4."""
    gradient = np.random.default_rng(0).standard_normal(shape)
    params = {"policy": {"kernel": jnp.zeros(shape), "bias": jnp.zeros(shape[-1])}, "rate": {"kernel": jnp.zeros(())}}
    optimizer = make_optimizer(OptimizerConfig(name="muon", learning_rate=3e-3), STEPS)
    grads = {"policy": {"kernel": jnp.asarray(gradient), "bias": jnp.ones(shape[-1])}, "rate": {"kernel": jnp.ones(())}}
    update, _ = optimizer.update(grads, optimizer.init(params), params)
    moved = -np.asarray(update["policy"]["kernel"]).reshape(-1, shape[-1])
    u, _, v = np.linalg.svd(gradient.reshape(-1, shape[-1]), full_matrices=False)
    nearest = u @ v
    cosine = (moved * nearest).sum() / np.linalg.norm(moved) / np.linalg.norm(nearest)
    assert cosine > 0.98, "five steps of Newton and Schulz come near it"
    assert np.sqrt(np.square(moved).mean()) == pytest.approx(0.4 * 3e-3, rel=0.25)
    others = optax.nadam(3e-3)
    expected = float(others.update(jnp.ones(()), others.init(jnp.zeros(())))[0])
    np.testing.assert_allclose(update["policy"]["bias"], expected, rtol=1e-4)
    np.testing.assert_allclose(update["rate"]["kernel"], expected, rtol=1e-4)


def test_an_optimizer_that_does_not_exist():
    with pytest.raises(ValueError, match=re.escape("optimizer.name: got 'sgd', expected one of adam, muon")):
        make_optimizer(OptimizerConfig(name="sgd"), STEPS)


def test_programs_compile_in_the_background_one_after_the_other(monkeypatch):
    lowered = types.SimpleNamespace(compile=lambda options: "the program")
    monkeypatch.setattr(Trainer, "run", types.SimpleNamespace(lower=lambda *_: lowered))
    trainer = types.SimpleNamespace(optimizer=optax.sgd(1.0))
    returned, order = threading.Event(), []

    def compile_other(number):
        assert returned.wait(10), "the caller waits for the compilation"
        order.append(number)

    others = [functools.partial(compile_other, number) for number in range(3)]
    program, *futures = compile_in_background(trainer, {}, {}, 1, others)
    returned.set()
    assert program.result() == "the program"
    for future in futures:
        future.result()
    assert order == [0, 1, 2]
