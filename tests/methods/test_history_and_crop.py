"""Policies that see a history of cropped images: what demonstrations hold of it, and what is remembered and cut out."""

import dataclasses
import functools
import pickle

import jax
import numpy as np
import pytest
from tiny import QUIET

import milx
from milx import methods
from milx.config.assemble import make_config
from milx.config.check import check_config
from milx.data.cameras import resized
from milx.data.dataset import DataSet, Writer, spread
from milx.data.frames import in_chunks
from milx.data.recorded import read_demos, read_later, sample_batch
from milx.deploy import standalone
from milx.export import export
from milx.training import recorded
from milx.training.factory import make_run
from milx.types import Demo, Observation, Spec
from milx.worlds.actor import Actor
from milx.worlds.slot import Episode, Outcome, Task

HISTORY, CROP, CHUNK, SIZES = 3, 2, 2, {"scene": (10, 12), "hand": (7, 8)}
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


def middle(image):
    return {name: x[..., CROP : x.shape[-3] - CROP, CROP : x.shape[-2] - CROP, :] for name, x in image.items()}


def at(demo, t):
    return Observation(jax.tree.map(lambda x: x[t], demo.image), demo.state[t])


def seen_inside(demo, t):
    """Returns what the method inside sees: the middle of the images of a history."""
    seen = seen_at(demo, t)
    return Observation(middle(seen.image), seen.state)


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


@pytest.fixture(
    scope="module",
    params=[pytest.param(method, marks=pytest.mark.slow) for method in ("mil", "contextual", "lstm")],
)
def run(request, cache, folder, tmp_path_factory):
    config = recorded.config_for(folder, request.param, "cpu")
    config.recorded.horizon, config.recorded.history, config.recorded.crop = 6, HISTORY, CROP
    config.recorded.shift, config.recorded.recolor, config.recorded.goal_indices = 1, 0.1, (0, 1)
    config.method.chunk = config.method.execute = CHUNK
    config.network.filters, config.network.strides, config.network.fc_layers = (4, 4), (2, 1), (8,)
    config.network.goal_head, config.method.goal_weight = True, 1.0
    config.train.steps = config.train.log_every = config.train.eval_every = 2
    config.train.meta_batch = 2
    run = make_run(config, tmp_path_factory.mktemp("run"), QUIET)
    run.train()
    return run


@pytest.fixture(scope="module")
def policy(run):
    return milx.load(run.folder)


def test_a_policy_adapts_to_the_middle_of_what_a_loop_has_put_side_by_side(policy, folder):
    demo = DataSet(folder).read(0, 1)
    shown = [seen_at(demo, t) for t in spread(11, 6)]
    image, state = jax.tree.map(lambda *xs: np.stack(xs)[None], *((seen.image, seen.state) for seen in shown))
    prepared = policy.prepared(demo)
    equal((image, state), (prepared.image, prepared.state))
    inside = dataclasses.replace(prepared, image=middle(prepared.image))
    learned = jax.jit(policy.method.predictor.adapt)(policy.params, inside)
    close = functools.partial(np.testing.assert_allclose, atol=1e-6)
    jax.tree.map(close, policy.adapt(policy.params, demo), learned)


def test_a_policy_and_its_export_act_on_what_they_have_seen(policy, folder, tmp_path):
    """Gives the method inside, without a memory, what a loop has put side by side: chunks of two, both executed."""
    demo, query = DataSet(folder).read(0, 1), random_demo(7)
    learned = policy.adapt(policy.params, demo)
    expected, again = [], pickle.loads(pickle.dumps(policy))
    for t in range(0, 7, CHUNK):
        plan = policy.method.predictor.act(learned, seen_inside(query, t), ())[0]
        expected += list(np.reshape(plan, (CHUNK, 2)))
    export(policy, tmp_path / "exported")
    alone = standalone.Policy(tmp_path / "exported")
    known = alone.adapt(image=demo.image, state=demo.state, action=demo.action)
    memories = policy.initial_memory, again.initial_memory, alone.initial_memory
    for t in range(7):
        seen = at(query, t)
        actions, memories = zip(
            policy.step(learned, seen, memories[0]),
            again.step(learned, seen, memories[1]),
            alone.step(known, memories[2], image=seen.image, state=seen.state),
            strict=True,
        )
        for action in actions:
            np.testing.assert_allclose(action, expected[t], atol=1e-5)
    with pytest.raises(ValueError, match="memory: missing"):
        policy.act(learned, seen)
    header = tmp_path / "exported" / "policy.json"
    header.write_text(header.read_text().replace('"history": 3', '"history": 9'))
    with pytest.raises(ValueError, match=r"policy\.json: history: got 9, expected 3, as adapt takes .* of 9"):
        standalone.Policy(tmp_path / "exported")


def test_an_exported_policy_shrinks_images_and_then_cuts_the_middle_out(policy, folder, tmp_path):
    """Gives it the camera's own size, and images whose border alone is different."""
    demo, seen = DataSet(folder).read(0, 1), at(random_demo(1), 0)
    export(policy, tmp_path / "exported")
    alone = standalone.Policy(tmp_path / "exported")
    learned = alone.adapt(image=demo.image, state=demo.state, action=demo.action)

    def act(image):
        return np.asarray(alone.step(learned, alone.initial_memory, image=image, state=seen.state)[0])

    action = act(seen.image)
    black = {name: np.zeros_like(x) for name, x in seen.image.items()}
    for name, x in middle(seen.image).items():
        black[name][CROP:-CROP, CROP:-CROP] = x
    np.testing.assert_array_equal(act(black), action)
    black["scene"][CROP] ^= 255
    assert np.abs(act(black) - action).max() > 1e-4
    large = {name: RNG.integers(0, 256, (3 * size[0], 3 * size[1], 3), np.uint8) for name, size in SIZES.items()}
    small = {name: next(resized([image], SIZES[name])) for name, image in large.items()}
    np.testing.assert_allclose(act(large), act(small), atol=0.02)


def test_the_error_on_held_out_tasks_is_that_of_the_policy(run, policy):
    """Compares with a loop over the test task's other demonstration."""

    def chunks(task, number):
        demo = run.data.read(task, number)
        return in_chunks(demo.action, CHUNK)[spread(len(demo.action), 6)]

    scale = np.concatenate([chunks(task, number) for task in (2, 3, 4) for number in range(2)]).std(axis=0)
    learned, query = policy.adapt(policy.params, run.data.read(1, 0)), run.data.read(1, 1)
    frames = spread(11, 6)
    said = [policy.method.predictor.act(learned, seen_inside(query, t), ())[0] for t in frames]
    expected = np.mean(((np.stack(said) - chunks(1, 1)) / scale) ** 2)
    np.testing.assert_allclose(run.evaluate()["action_error"]["after"], expected, rtol=1e-4)


def test_in_every_world_the_history_begins_with_the_episode(policy, folder):
    """Starts a second episode in one of two worlds, and compares all with episodes that are done alone."""
    demo = DataSet(folder).read(0, 1)
    actor = Actor(policy, [Task("one", "", (demo,))], 2)
    episodes = [random_demo(6), random_demo(3), random_demo(3)]
    learned = policy.adapt(policy.params, demo)

    def alone(episode):
        memory, actions = policy.initial_memory, []
        for t in range(len(episode.state)):
            action, memory = policy.step(learned, at(episode, t), memory)
            actions.append(action)
        return actions

    outcome = Outcome(Episode("own", 0, 0))
    found = [[], [], []]
    for t in range(6):
        second, step = (1, t) if t < 3 else (2, t - 3)
        for world, first in ((0, t == 0), (1, step == 0)):
            if first:
                actor.assign(world, outcome.episode)
        seen = [at(episodes[number], i) for number, i in ((0, t), (second, step))]
        for number, action in zip((0, second), actor.act(seen, [outcome, outcome]), strict=True):
            found[number].append(action)
    for episode, actions in zip(episodes, found, strict=True):
        np.testing.assert_allclose(actions, alone(episode), atol=1e-5)


def test_a_memory_that_a_program_asks_for_first_is_none_of_its_tracers(policy):
    again = pickle.loads(pickle.dumps(policy))
    inside = jax.jit(lambda: again.initial_memory)()
    equal(inside, again.initial_memory)


def test_values_that_only_a_history_sees_are_checked_as_well(cache, tmp_path):
    """Has one in a validation task, at a time step that is not among those that it is resampled to."""
    with Writer(tmp_path / "set", None, 1, 1) as writer:
        for task in range(3):
            demos = [Demo(None, np.zeros((31, 1), np.float32), np.ones((31, 1), np.float32)) for _ in range(2)]
            if task == 0:
                demos[1].state[9] = np.nan
            writer.add(f"task {task}", ("validation", "test", "train")[task], [31, 31], demos)
    assert 9 not in spread(31, 4)
    config = recorded.config_for(tmp_path / "set", preset="cpu")
    config.recorded.horizon, config.recorded.history, config.network.fc_layers = 4, 2, (8,)
    with pytest.raises(ValueError, match=r"data: state of demonstration 1 of task 0 .*: got values that are not"):
        make_run(config, tmp_path / "run", QUIET).train()


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


@pytest.mark.slow
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


def test_filters_are_made_from_the_middle_of_what_each_camera_sees_first(folder, tmp_path):
    config = recorded.config_for(folder, preset="cpu")
    config.recorded.crop, config.network.fixed_filters = CROP, "kmeans"
    data, run = DataSet(folder), make_run(config, tmp_path / "run", QUIET)
    first = [middle(data.read(task, 0, np.zeros(1, int)).image) for task in (2, 3, 4)]  # those for training
    for found, name in zip(run._first_images(), sorted(SIZES), strict=True):
        np.testing.assert_array_equal(found, np.concatenate([image[name] for image in first]))


def test_crops_that_cannot_be_are_refused():
    simulated = make_config("reach", preset="cpu")
    simulated.recorded.crop = 1
    with pytest.raises(ValueError, match=r"recorded\.crop: got 1, expected 0 in simulation"):
        check_config(simulated)
    config = make_config("recorded", preset="cpu")
    config.recorded.crop = 4
    with pytest.raises(ValueError, match=r"recorded\.crop: got 4, expected less than half of image\.hand, of 8 x 9"):
        methods.make(config, Spec({"scene": (20, 20), "hand": (8, 9)}, 3, 2, None, ()))
    with pytest.raises(ValueError, match=r"recorded\.crop: got 4, expected 0: this policy sees no pixels"):
        methods.make(config, Spec(None, 3, 2, None, ()))
