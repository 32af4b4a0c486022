"""Policies that have learned from images cut out at random, and see the middle of the images that they are given."""

import dataclasses

import jax
import numpy as np
import pytest
from tiny import QUIET

import milx
from milx import methods
from milx.config.assemble import make_config
from milx.config.check import check_config
from milx.data.cameras import resized
from milx.data.dataset import Writer
from milx.deploy import standalone
from milx.export import export
from milx.training import recorded
from milx.training.factory import make_run
from milx.types import Demo, Observation, Spec

CROP, SIZES = 2, {"scene": (10, 12), "hand": (7, 8)}
RNG = np.random.default_rng(0)


def random_demo(length):
    image = {name: RNG.integers(0, 256, (length, *size, 3), np.uint8) for name, size in SIZES.items()}
    return Demo(image, RNG.normal(size=(length, 3)).astype(np.float32), RNG.normal(size=(length, 2)).astype(np.float32))


def middle(image):
    return {name: x[..., CROP : x.shape[-3] - CROP, CROP : x.shape[-2] - CROP, :] for name, x in image.items()}


def at(demo, t):
    return Observation(jax.tree.map(lambda x: x[t], demo.image), demo.state[t])


@pytest.fixture(scope="module", params=["mil", "contextual", "lstm"])
def run(request, cache, tmp_path_factory):
    folder = tmp_path_factory.mktemp("crop")
    with Writer(folder / "set", SIZES, 3, 2) as writer:
        for task in range(5):
            demos = [random_demo(6) for _ in range(2)]
            writer.add(f"task {task}", ("validation", "test", *["train"] * 3)[task], [6, 6], demos)
    config = recorded.config_for(folder / "set", request.param, "cpu")
    config.recorded.horizon, config.recorded.crop, config.recorded.history = 6, CROP, 2
    config.network.filters, config.network.strides, config.network.fc_layers = (4, 4), (2, 1), (8,)
    config.train.steps = config.train.log_every = config.train.eval_every = 2
    config.train.meta_batch = 2
    run = make_run(config, folder / "run", QUIET)
    run.train()
    return run


@pytest.fixture(scope="module")
def policy(run):
    return milx.load(run.folder)


def test_a_policy_adapts_to_the_middle_and_acts_on_it(policy):
    """Gives the method inside what NumPy cuts out, and two observations side by side."""
    demo, query, inside = policy.prepared(random_demo(6)), random_demo(3), policy.method.predictor
    learned = policy.method.adapt(policy.params, demo)
    expected = inside.adapt(policy.params, dataclasses.replace(demo, image=middle(demo.image)))
    jax.tree.map(np.testing.assert_array_equal, learned, expected)
    memory = policy.initial_memory
    for t in range(3):
        now, before = (middle(at(query, step).image) for step in (t, max(t - 1, 0)))
        image = {name: np.concatenate([now[name], before[name]], axis=-1) for name in now}
        state = np.concatenate([query.state[t], query.state[max(t - 1, 0)]])
        action, memory = policy.step(learned, at(query, t), memory)
        np.testing.assert_allclose(action, inside.act(learned, Observation(image, state), ())[0], atol=1e-5)


def test_the_error_on_held_out_tasks_is_that_of_the_policy(run, policy):
    """Compares with a loop over the test task's other demonstration."""
    actions = np.concatenate([run.data.read(task, number).action for task in (2, 3, 4) for number in range(2)])
    shown, query = (run.data.read(1, number) for number in range(2))
    learned, memory, squares = policy.adapt(policy.params, shown), policy.initial_memory, []
    for t in range(6):
        action, memory = policy.step(learned, at(query, t), memory)
        squares.append(((action - query.action[t]) / actions.std(axis=0)) ** 2)
    np.testing.assert_allclose(run.evaluate()["action_error"]["after"], np.mean(squares), rtol=1e-4)


def test_an_exported_policy_shrinks_images_and_then_cuts_the_middle_out(policy, tmp_path):
    """Gives it the camera's own size, and images whose border alone is different."""
    demo, seen = random_demo(6), at(random_demo(1), 0)
    export(policy, tmp_path / "exported")
    alone = standalone.Policy(tmp_path / "exported")
    learned = alone.adapt(image=demo.image, state=demo.state, action=demo.action)

    def act(image):
        return np.asarray(alone.step(learned, alone.initial_memory, image=image, state=seen.state)[0])

    action = act(seen.image)
    known = policy.adapt(policy.params, demo)
    np.testing.assert_allclose(action, policy.step(known, seen, policy.initial_memory)[0], atol=1e-5)
    black = {name: np.zeros_like(x) for name, x in seen.image.items()}
    for name, x in middle(seen.image).items():
        black[name][CROP:-CROP, CROP:-CROP] = x
    np.testing.assert_array_equal(act(black), action)
    black["scene"][CROP] ^= 255
    assert np.abs(act(black) - action).max() > 1e-4
    large = {name: RNG.integers(0, 256, (3 * size[0], 3 * size[1], 3), np.uint8) for name, size in SIZES.items()}
    small = {name: next(resized([image], SIZES[name])) for name, image in large.items()}
    np.testing.assert_allclose(act(large), act(small), atol=0.02)


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
