"""Chunks of actions: what of them is executed, what demonstrations hold of them, and a policy that predicts them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import QUIET
from told import Told

import milx
from milx import methods
from milx.config.assemble import make_config
from milx.data.dataset import DataSet, Writer, spread
from milx.data.frames import in_chunks
from milx.data.recorded import read_later
from milx.deploy import standalone
from milx.export import export
from milx.methods.chunks import FADE, Chunked
from milx.training import recorded
from milx.training.factory import make_run
from milx.types import Demo, Observation, Spec

CHUNK, ACTION = 4, 2
RNG = np.random.default_rng(0)


def executed(execute, plans):
    policy = Chunked(Told(), CHUNK, execute, ACTION)
    memory, actions = policy.initial_memory(jax.random.key(0)), []
    act = jax.jit(policy.act)
    for plan in plans:
        action, memory = act((), Observation(state=jnp.asarray(plan.ravel())), memory)
        actions.append(action)
    return np.stack(actions)


@pytest.mark.parametrize("execute", [1, 3, 4])
def test_so_many_actions_of_a_chunk_are_executed(execute):
    plans = RNG.normal(size=(11, CHUNK, ACTION)).astype(np.float32)
    expected = [plans[t - t % execute][t % execute] for t in range(len(plans))]
    np.testing.assert_allclose(executed(execute, plans), expected, rtol=1e-6)


def test_the_mean_is_over_all_chunks_that_hold_the_time_step():
    plans = RNG.normal(size=(9, CHUNK, ACTION)).astype(np.float32)
    expected = []
    for t in range(len(plans)):
        ages = range(min(t + 1, CHUNK))
        weights = [np.exp(FADE * age) for age in ages]
        says = [plans[t - age][age] for age in ages]
        expected.append(np.average(says, axis=0, weights=weights))
    np.testing.assert_allclose(executed(0, plans), expected, rtol=1e-5, atol=1e-6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("chunks") / "set"
    with Writer(folder, None, 3, ACTION) as writer:
        for task in range(5):
            lengths = [7, 12]
            demos = [Demo(None, RNG.normal(size=(n, 3)), RNG.normal(size=(n, ACTION))) for n in lengths]
            writer.add(f"task {task}", ("validation", "test", *["train"] * 3)[task], lengths, demos)
    return folder


def test_demonstrations_hold_the_actions_of_their_own_next_time_steps(folder):
    """Compares with a loop; resampling to fewer time steps does not change which actions come next."""
    data = DataSet(folder)
    whole = data.read(3, 1)
    read = read_later(data, 3, 1, 5, CHUNK)()
    for row, t in enumerate(spread(12, 5)):
        np.testing.assert_array_equal(read.state[row], whole.state[t])
        expected = np.concatenate([whole.action[min(t + c, 11)] for c in range(CHUNK)])
        np.testing.assert_array_equal(read.action[row], expected)
    np.testing.assert_array_equal(in_chunks(whole.action, CHUNK)[spread(12, 5)], read.action)


@pytest.mark.slow
def test_a_policy_predicts_chunks_and_its_export_executes_them_alike(cache, folder, tmp_path):
    config = recorded.config_for(folder, preset="cpu")
    config.recorded.horizon, config.network.fc_layers = 6, (8,)
    config.method.chunk, config.method.execute = CHUNK, 0
    config.train.steps = config.train.log_every = config.train.eval_every = 2
    config.train.meta_batch = 2
    run = make_run(config, tmp_path / "run", QUIET)
    run.train()
    assert np.isfinite(run.evaluate()["score"])
    policy = milx.load(tmp_path / "run")
    assert policy.params["whitening"].action_mean.shape == (CHUNK * ACTION,)
    export(policy, tmp_path / "exported")
    alone, demo = standalone.Policy(tmp_path / "exported"), DataSet(folder).read(0, 1)
    learned, expected = alone.adapt(state=demo.state, action=demo.action), policy.adapt(policy.params, demo)
    memories = alone.initial_memory, policy.initial_memory
    plans = []
    for state in demo.state:
        action, *memories = zip(
            alone.step(learned, memories[0], state=state),
            policy.step(expected, Observation(state=state), memories[1]),
            strict=True,
        )
        memories = memories[0]
        np.testing.assert_allclose(action[0], action[1], atol=1e-5)
        plans.append(policy.method.method.act(expected, Observation(state=state), ())[0])
    # The last action is the mean of what the last chunks say of its time step, not what the last one says.
    says = [np.reshape(plans[-1 - age], (CHUNK, ACTION))[age] for age in range(CHUNK)]
    mean = np.average(says, axis=0, weights=np.exp(FADE * np.arange(CHUNK)))
    np.testing.assert_allclose(action[1], mean, atol=1e-5)
    with pytest.raises(ValueError, match="memory: missing"):
        policy.act(expected, Observation(state=demo.state[0]))


def test_chunks_that_cannot_be_are_refused():
    config = make_config("recorded", preset="cpu")
    config.network.filters = config.network.strides = ()
    config.network.soft_argmax = config.network.mixed_precision = False
    config.method.chunk, config.method.execute = 2, 3
    with pytest.raises(ValueError, match=r"method\.execute: got 3, expected at most method\.chunk = 2"):
        methods.make(config, Spec(None, 3, 2, None, ()))
