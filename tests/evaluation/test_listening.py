"""Whether a policy listens: errors and steps against loops over the tasks."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from milx.config import assemble
from milx.config.assemble import make_config
from milx.config.schema import TrainConfig
from milx.evaluation import listening
from milx.methods import Method
from milx.methods.mil import MIL, MILConfig
from milx.methods.whitening import Whitening
from milx.networks.policy_network import PolicyNetwork, PolicyOutput
from milx.training.update import Trainer, TrainState
from milx.types import Demo, TaskBatch

TASKS, STEPS, STATE, ACTION = 4, 6, 3, 2
THETA = np.array([0.4, -1.3])


@dataclasses.dataclass(frozen=True, eq=False)
class Mean(Method):
    """Does what the demonstration did on average, or if it is deaf always the same."""

    deaf: bool = False

    def init(self, key, whitening):
        return ()

    def loss(self, params, batch, progress=1.0):
        raise NotImplementedError

    def adapt(self, params, demo):
        return params if self.deaf else demo.action.mean(axis=(0, 1))

    def act(self, task_params, observation, memory):
        return task_params + 0 * observation.state[0], memory


@pytest.fixture(scope="module")
def batch():
    rng = np.random.default_rng(0)
    place = rng.standard_normal((TASKS, 1, 1, ACTION))

    def demos(count):
        action = place + 0.3 * rng.standard_normal((TASKS, count, STEPS, ACTION))
        return Demo(state=jnp.asarray(rng.standard_normal((TASKS, count, STEPS, STATE))), action=jnp.asarray(action))

    return TaskBatch(demos(1), demos(2))


def measure(method, params, batch, most=None):
    found = jax.jit(lambda params, batch: listening.measure(method, params, batch, most))(params, batch)
    return {name: float(value) for name, value in found.items()}


@pytest.mark.parametrize("most", [None, 1])
def test_errors_are_those_of_a_loop_over_the_tasks(batch, most):
    shown, asked = np.asarray(batch.support.action), np.asarray(batch.query.action)
    variance = asked.reshape(-1, ACTION).var(axis=0)

    def error(demo_of):
        each = [(shown[demo_of(i)].mean(axis=(0, 1)) - asked[i]) ** 2 / variance for i in range(TASKS)]
        return np.mean(each)

    found = measure(Mean(), jnp.zeros(ACTION), batch, most)
    expected = {"own_demo": error(lambda i: i), "other_demo": error(lambda i: (i + 1) % TASKS)}
    assert found == pytest.approx(expected, rel=1e-5)
    assert not listening.is_deaf(found)
    alone = measure(Mean(), jnp.zeros(ACTION), jax.tree.map(lambda x: x[:1], batch))
    assert set(alone) == {"own_demo"}  # there is no other task
    deaf = measure(Mean(deaf=True), jnp.zeros(ACTION), batch, most)
    assert deaf["own_demo"] == deaf["other_demo"]
    assert listening.is_deaf(deaf)


@pytest.mark.parametrize("other, step, warned", [(1.04, 60, True), (1.06, 60, False), (1.04, 59, False)])
def test_a_run_that_does_not_listen_is_warned_after_a_fifth_of_its_inner_steps(other, step, warned):
    """Warns if another task's demonstration makes the error at most a twentieth larger, as the documentation says."""
    errors = {"own_demo": 1.0, "other_demo": other}
    imitates = MIL(MILConfig(imitation_steps=50), CONSTANT)
    found = listening.warning(errors | {"no_demo": 2.0}, step, 100, imitates)
    assert found == (listening.advice(has_inner_step=True) if warned else None)
    assert listening.warning(errors, step - 40, 100, Mean()) == (listening.advice(False) if warned else None)


def test_an_entry_that_never_changes_has_a_finite_error(batch):
    """Divides by the least variance of the whitening, 1e-6."""
    still = dataclasses.replace(batch.query, action=batch.query.action.at[..., 1].set(0.5))
    shown = dataclasses.replace(batch.support, action=batch.support.action.at[..., 1].set(0.503))
    found = measure(Mean(), jnp.zeros(ACTION), TaskBatch(shown, still))
    moving = np.asarray(batch.query.action)[..., 0], np.asarray(batch.support.action)[..., 0].mean(axis=(1, 2))
    error = np.mean((moving[1][:, None, None] - moving[0]) ** 2) / moving[0].var()
    assert found["own_demo"] == pytest.approx((error + 0.003**2 / 1e-6) / 2, rel=1e-3)


PLAIN = Whitening(np.zeros(STATE), np.ones(STATE), np.zeros(ACTION), np.ones(ACTION))
CONSTANT = PolicyNetwork(
    init=lambda key: {"a": jnp.asarray(THETA)},
    apply=lambda theta, image, state, *_: PolicyOutput(
        *[jnp.broadcast_to(theta["a"], (len(state), ACTION))] * 2, goal=None, feature_map=None, features=state
    ),
)


def test_the_size_of_the_step_is_relative_to_the_tensor(batch):
    """Moves a constant policy by 2 alpha / A of the way to the demonstration's mean action."""
    alpha = 0.1
    method = MIL(MILConfig(inner_lr=alpha, inner_clip=1e9), CONSTANT)
    found = measure(method, {"policy": {"a": jnp.asarray(THETA)}, "whitening": PLAIN}, batch)
    way = np.asarray(batch.support.action).mean(axis=(1, 2)) - THETA
    size = lambda x: np.sqrt(np.mean(x**2, axis=-1))  # noqa: E731
    assert found["step/policy.a"] == pytest.approx(2 * alpha / ACTION * size(way).mean() / size(THETA), rel=1e-5)
    assert [name for name in found if name.startswith("step/")] == ["step/policy.a"]
    asked = np.asarray(batch.query.action)
    before = np.mean((THETA - asked) ** 2 / asked.reshape(-1, ACTION).var(axis=0))
    assert found["no_demo"] == pytest.approx(before, rel=1e-5)
    assert found["own_demo"] < found["no_demo"]


@pytest.mark.slow
def test_a_run_imitates_first_and_measures_the_batch_that_comes_next(batch):
    method, rate = MIL(MILConfig(inner_lr=0.1, inner_clip=1e9, imitation_steps=2), CONSTANT), 0.05
    train = TrainConfig(steps=10, meta_batch=TASKS)
    rolled = lambda key: jax.random.randint(key, (), 0, 5)  # noqa: E731

    def sample(data, keys):
        return jax.tree.map(lambda x: x + rolled(keys[0]), data)

    trainer, params = Trainer(sample, method, train, optax.sgd(rate)), {"policy": {"a": jnp.asarray(THETA)}}
    params["whitening"] = jax.tree.map(jnp.asarray, PLAIN)
    state, key = TrainState(jnp.zeros((), jnp.int32), params, optax.sgd(rate).init(params)), jax.random.key(1)
    after, metrics = trainer.run(state, batch, key, 3)

    theta = jnp.asarray(THETA)
    for step in range(3):
        drawn = sample(batch, trainer._keys(key, jnp.asarray(step)))
        loss = method.imitation if step < 2 else method.loss
        slope = jax.grad(lambda a, loss=loss, drawn=drawn: loss({**params, "policy": {"a": a}}, drawn)[0])(theta)
        theta = theta - rate * slope
    np.testing.assert_allclose(after.params["policy"]["a"], theta, rtol=1e-5)
    following = sample(batch, trainer._keys(key, jnp.asarray(3)))
    expected = measure(method, {**params, "policy": {"a": theta}}, following)
    assert {name: float(metrics[name]) for name in expected} == pytest.approx(expected, rel=1e-4)


def test_progress_counts_the_updates_with_an_inner_step(batch):
    """Expects equal weights of the multi-step loss in the first update with an inner step, whenever that is."""
    config = MILConfig(inner_lr=0.1, inner_clip=1e9, inner_steps=2, variant="multi_step", imitation_steps=6)
    method = MIL(config, CONSTANT)
    params = {"policy": {"a": jnp.asarray(THETA)}, "whitening": PLAIN}
    trainer = Trainer(None, method, TrainConfig(steps=10, meta_batch=TASKS), optax.sgd(0.1))
    for step, progress in ((6, 0.0), (8, 0.5)):
        _, metrics = jax.jit(trainer._gradient)(params, batch, jnp.asarray(step))
        expected = method.loss(params, batch, progress)[1]["loss"]
        np.testing.assert_allclose(metrics["loss"], expected, rtol=1e-5)


@pytest.mark.parametrize("has_inner_step", [True, False])
def test_advice_names_fields_that_exist(has_inner_step):
    named = re.findall(r"(?<![\w.])(?:method|train|network|optimizer|mil)\.\w+", listening.advice(has_inner_step))
    assert len(named) >= 2
    assert set(named) <= set(assemble.fields(make_config("reach", "mil" if has_inner_step else "lstm")))
