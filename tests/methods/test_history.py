"""Policies that see a history: what demonstrations hold of it, what is remembered, and a task that needs it."""

import dataclasses
import pickle

import jax
import numpy as np
import pytest
from tiny import QUIET

import milx
from milx import methods
from milx.config.assemble import make_config
from milx.config.check import check_config
from milx.data.dataset import DataSet, Writer, spread
from milx.data.recorded import read_demos, read_later, sample_batch
from milx.deploy import standalone
from milx.export import export
from milx.training import recorded
from milx.training.factory import make_run
from milx.types import Demo, Observation, Spec
from milx.worlds.actor import Actor
from milx.worlds.slot import Episode, Outcome, Task

HISTORY, SIZES = 3, {"scene": (8, 10), "hand": (6, 6)}
RNG = np.random.default_rng(0)


def random_demo(length):
    image = {name: RNG.integers(0, 256, (length, *size, 3), np.uint8) for name, size in SIZES.items()}
    return Demo(image, RNG.normal(size=(length, 3)).astype(np.float32), RNG.normal(size=(length, 2)).astype(np.float32))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("history") / "set"
    with Writer(folder, SIZES, 3, 2) as writer:
        for task in range(5):
            demos = [random_demo(length) for length in (5, 11)]
            writer.add(f"task {task}", ("validation", "test", *["train"] * 3)[task], [5, 11], demos)
    return folder


def seen_at(demo, t, history=HISTORY):
    """Puts the observations up to a time step side by side in a loop, the latest first."""
    steps = [max(t - i, 0) for i in range(history)]
    image = {name: np.concatenate([x[step] for step in steps], axis=-1) for name, x in demo.image.items()}
    return Observation(image, np.concatenate([demo.state[step] for step in steps]))


def equal(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.mark.parametrize("horizon", [4, 20])
def test_demonstrations_hold_the_observations_of_their_own_last_time_steps(folder, horizon):
    """Compares with a loop; the steps before are the recording's, whatever it is resampled to."""
    data = DataSet(folder)
    whole = data.read(3, 1)
    read = read_later(data, 3, 1, horizon, history=HISTORY)()
    for row, t in enumerate(spread(11, horizon)):
        expected = seen_at(whole, t)
        equal(jax.tree.map(lambda x, row=row: x[row], read.image), expected.image)
        equal(read.state[row], expected.state)
        equal(read.action[row], whole.action[t])
    equal(read_later(data, 3, 1, horizon)(), data.read(3, 1, spread(11, horizon)))


def test_the_latest_observation_of_a_history_is_what_there_is_without_one(folder):
    """Draws the same batches with and without a history, with time steps, shifts, colors and goals."""
    data, keys = DataSet(folder), jax.random.split(jax.random.key(0), 4)

    def draw(history):
        loaded = jax.device_put(read_demos(data, [2, 3, 4], [[0, 1]] * 3, 8, 2, history))
        return jax.jit(lambda keys: sample_batch(loaded, keys, 1, 3, 5, 1.0, True, (2, 0), 2, 0.2))(keys)

    one, several = draw(1), draw(HISTORY)

    def latest(demo):
        image = jax.tree.map(lambda x: x[..., :3], demo.image)
        return dataclasses.replace(demo, image=image, state=demo.state[..., :3])

    equal(one.support, latest(several.support))
    equal(one.query, latest(several.query))


def tiny(folder, method="mil"):
    config = recorded.config_for(folder, method, "cpu")
    config.recorded.horizon, config.recorded.history = 6, HISTORY
    config.recorded.shift, config.recorded.recolor, config.recorded.goal_indices = 1, 0.1, (0, 1)
    config.method.chunk, config.method.execute = 2, 2
    config.network.filters, config.network.strides, config.network.fc_layers = (4, 4), (2, 1), (8,)
    config.network.goal_head, config.method.goal_weight = True, 1.0
    config.train.steps = config.train.log_every = config.train.eval_every = 2
    config.train.meta_batch = 2
    return config


@pytest.fixture(scope="module", params=["mil", "contextual", "lstm"])
def policy(request, cache, folder, tmp_path_factory):
    run = make_run(tiny(folder, request.param), tmp_path_factory.mktemp("run"), QUIET)
    run.train()
    assert np.isfinite(run.evaluate()["score"])
    return milx.load(run.folder)


def test_a_policy_and_its_export_act_on_what_they_have_seen(policy, folder, tmp_path):
    """Gives the method inside, without a memory, what a loop has put side by side: chunks of two, both executed."""
    demo, query = DataSet(folder).read(0, 1), random_demo(7)
    learned = policy.adapt(policy.params, demo)
    stacked = [seen_at(demo, t) for t in spread(11, 6)]
    shown = jax.tree.map(lambda *xs: np.stack(xs)[None], *stacked)
    prepared = policy.prepared(demo)
    equal((shown.image, shown.state), (prepared.image, prepared.state))
    expected, again = [], pickle.loads(pickle.dumps(policy))
    for t in range(0, 7, 2):
        plan = policy.method.predictor.act(learned, seen_at(query, t), ())[0]
        expected += list(np.reshape(plan, (2, 2)))
    export(policy, tmp_path / "exported")
    alone = standalone.Policy(tmp_path / "exported")
    known = alone.adapt(image=demo.image, state=demo.state, action=demo.action)
    memories = policy.initial_memory, again.initial_memory, alone.initial_memory
    for t in range(7):
        image, state = jax.tree.map(lambda x, t=t: x[t], query.image), query.state[t]
        seen = Observation(image, state)
        actions, memories = zip(
            policy.step(learned, seen, memories[0]),
            again.step(learned, seen, memories[1]),
            alone.step(known, memories[2], image=image, state=state),
            strict=True,
        )
        for action in actions:
            np.testing.assert_allclose(action, expected[t], atol=1e-5)
    with pytest.raises(ValueError, match="memory: missing"):
        policy.act(learned, seen)


def test_in_every_world_the_history_begins_with_the_episode(policy, folder):
    """Starts a second episode in one of two worlds, and compares all with episodes that are done alone."""
    demo = DataSet(folder).read(0, 1)
    actor = Actor(policy, [Task("one", "", (demo,))], 2)
    episodes = [random_demo(6), random_demo(3), random_demo(3)]
    learned = policy.adapt(policy.params, demo)

    def alone(episode):
        memory, actions = policy.initial_memory, []
        for t in range(len(episode.state)):
            seen = Observation(jax.tree.map(lambda x, t=t: x[t], episode.image), episode.state[t])
            action, memory = policy.step(learned, seen, memory)
            actions.append(action)
        return actions

    outcome = Outcome(Episode("own", 0, 0))
    found = [[], [], []]
    for t in range(6):
        second, step = (1, t) if t < 3 else (2, t - 3)
        for world, first in ((0, t == 0), (1, step == 0)):
            if first:
                actor.assign(world, outcome.episode)
        seen = [
            Observation(jax.tree.map(lambda x, i=i: x[i], episodes[number].image), episodes[number].state[i])
            for number, i in ((0, t), (second, step))
        ]
        for number, action in zip((0, second), actor.act(seen, [outcome, outcome]), strict=True):
            found[number].append(action)
    for episode, actions in zip(episodes, found, strict=True):
        np.testing.assert_allclose(actions, alone(episode), atol=1e-5)


@pytest.fixture(scope="module")
def differences(tmp_path_factory):
    """Writes demonstrations whose action is by how much the state, drawn anew at every step, has changed."""
    folder = tmp_path_factory.mktemp("differences") / "set"
    with Writer(folder, None, 1, 1) as writer:
        for task in range(10):
            demos = []
            for _ in range(3):
                state = RNG.uniform(-1, 1, (30, 1)).astype(np.float32)
                demos.append(Demo(None, state, np.diff(state, axis=0, prepend=state[:1])))
            writer.add(f"task {task}", ("validation", "test", *["train"] * 8)[task], [30] * 3, demos)
    return folder


@pytest.mark.parametrize("history", [1, 2])
def test_only_a_history_tells_by_how_much_the_state_has_changed(cache, differences, tmp_path, history):
    """Without one, the state before is unknown: half of the variance of the difference of two equal draws."""
    config = recorded.config_for(differences, preset="cpu")
    config.recorded.horizon, config.recorded.history, config.network.fc_layers = 30, history, (40,)
    config.train.steps = config.train.eval_every = 400
    config.train.meta_batch, config.train.log_every = 8, 100
    run = make_run(config, tmp_path / "run", QUIET)
    run.train()
    errors = run.evaluate()["action_error"]
    relative = errors["after"] / errors["mean_action"]
    assert relative < 0.05 if history == 2 else relative > 0.4


def test_histories_that_cannot_be_are_refused():
    simulated = make_config("reach", preset="cpu")
    simulated.recorded.history = 2
    with pytest.raises(ValueError, match=r"recorded\.history: got 2, expected 1 in simulation"):
        check_config(simulated)
    config = make_config("recorded", preset="cpu")
    config.recorded.history, config.network.fixed_filters = 2, "kmeans"
    with pytest.raises(ValueError, match=r"fixed_filters: got 'kmeans', expected None: .* recorded\.history = 2"):
        methods.make(config, Spec((8, 8), 3, 2, None, ()))
    config.recorded.history = 0
    with pytest.raises(ValueError, match=r"recorded\.history: got 0, expected a whole number, at least 1"):
        check_config(config)
