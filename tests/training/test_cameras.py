"""A run on demonstrations of two cameras of different sizes, from the data set to the exported policy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny import QUIET

import milx
from milx.data.cameras import resized, shrunk
from milx.data.dataset import DataSet, Writer
from milx.deploy import standalone
from milx.export import export
from milx.networks.policy_network import ConvStack, PolicyConfig, make_policy
from milx.training import recorded
from milx.training.factory import make_run
from milx.types import Demo, Observation

SIZES = {"scene": (12, 16), "hand": (8, 8)}
"""The goal head looks at the first one, which is the last by name."""
RNG = np.random.default_rng(0)


def random_demo(length):
    image = {name: RNG.integers(0, 256, (length, *size, 3), np.uint8) for name, size in SIZES.items()}
    return Demo(image, RNG.normal(size=(length, 3)).astype(np.float32), RNG.normal(size=(length, 2)).astype(np.float32))


@pytest.fixture(scope="module")
def demos():
    return [[random_demo(length) for length in (6, 9)] for _ in range(6)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory, demos):
    folder = tmp_path_factory.mktemp("cameras") / "set"
    names = {"state_names": ["x", "y", "z"], "action_names": ["dx", "dy"]}
    with Writer(folder, SIZES, 3, 2, "a test", fps=20, **names) as writer:
        for task, own in enumerate(demos):
            split = ("validation", "test", *["train"] * 4)[task]
            writer.add(f"task {task}", split, [6, 9], own, instructions=["do it", f"do {task}"])
    return folder


@pytest.fixture(scope="module")
def policy(cache, folder, tmp_path_factory):
    config = recorded.config_for(folder, preset="cpu")
    config.recorded.horizon = 6
    config.recorded.goal_indices = (0, 1)
    config.network.goal_head, config.method.goal_weight = True, 1.0
    config.network.filters, config.network.strides, config.network.fc_layers = (4, 4), (2, 1), (8,)
    config.train.steps = config.train.log_every = config.train.eval_every = 2
    config.train.meta_batch = 2
    run = make_run(config, tmp_path_factory.mktemp("run"), QUIET)
    run.train()
    assert np.isfinite(run.evaluate()["score"])
    return milx.load(run.folder)


def test_a_data_set_keeps_every_camera_and_what_it_says_of_itself(folder, demos):
    data = DataSet(folder)
    assert data.header.image_shape == SIZES
    assert (data.header.fps, data.header.state_names) == (20, ("x", "y", "z"))
    assert data.header.tasks[3].instructions == ("do it", "do 3")
    for task, own in enumerate(demos):
        for number, demo in enumerate(own):
            jax.tree.map(np.testing.assert_array_equal, data.read(task, number), demo)
            only = data.read(task, number, np.array([4, 1]), fields=("image",))
            jax.tree.map(np.testing.assert_array_equal, only.image, jax.tree.map(lambda x: x[[4, 1]], demo.image))


@pytest.mark.parametrize("share", [False, True])
def test_features_are_those_of_each_camera_side_by_side(share):
    """Computes the first layer by hand from each camera's convolutions."""
    config = PolicyConfig(filters=(4, 3), strides=(2, 1), fc_layers=(5,), fc_norm=False, share_encoder=share)
    config.bias_transformation = 0
    network = make_policy(config, SIZES, state_size=3, action_size=2, goal_size=0)
    params = network.init(jax.random.key(0))
    encoders = {name for name in params if name.startswith("vision")}
    assert encoders == ({"vision"} if share else {"vision_hand", "vision_scene"})
    demo = random_demo(5)
    output = network.apply(params, demo.image, jnp.asarray(demo.state))
    parts = []
    for name in sorted(SIZES):
        own = params["vision" if share else f"vision_{name}"]
        features = ConvStack(config).apply({"params": own}, demo.image[name], jnp.float32)
        parts.append(features.reshape(5, -1))
    first, last = params["controller"]["Dense_0"], params["controller"]["Dense_1"]
    hidden = np.maximum(np.concatenate([*parts, demo.state], axis=1) @ first["kernel"] + first["bias"], 0)
    np.testing.assert_allclose(output.action, hidden @ last["kernel"] + last["bias"], atol=1e-5)


@pytest.mark.slow
def test_the_goal_head_looks_at_the_first_camera(policy):
    """Changes one camera's image at a time."""
    demo, params = random_demo(6), policy.params["policy"]

    def say(image):
        output = policy.method.network.apply(params, image, jnp.zeros((6, 3)))
        return np.asarray(output.goal.mean), np.asarray(output.action)

    goal, action = say(demo.image)
    other_hand = say({**demo.image, "hand": 255 - demo.image["hand"]})
    np.testing.assert_array_equal(other_hand[0], goal)
    assert np.abs(other_hand[1] - action).max() > 1e-4
    assert np.abs(say({**demo.image, "scene": 255 - demo.image["scene"]})[0] - goal).max() > 1e-4


@pytest.mark.slow
def test_an_exported_policy_sees_both_cameras(policy, demos, tmp_path):
    export(policy, tmp_path / "exported")
    alone, demo = standalone.Policy(tmp_path / "exported"), demos[0][0]
    learned = alone.adapt(image=demo.image, state=demo.state, action=demo.action)
    expected = policy.adapt(policy.params, demo)
    for t in range(3):
        seen = {name: images[t] for name, images in demo.image.items()}
        action = policy.act(expected, Observation(seen, demo.state[t]))
        np.testing.assert_allclose(alone.act(learned, image=seen, state=demo.state[t]), action, atol=1e-5)
    with pytest.raises(ValueError, match=r"fields: got \['image\.hand', 'state'\], expected .*image\.scene"):
        alone.act(learned, image={"hand": seen["hand"]}, state=demo.state[0])


@pytest.mark.slow
def test_images_of_the_cameras_own_size_are_shrunk_as_at_import(policy, demos, tmp_path):
    """Compares an export with Pillow's filter, and with the policy; sizes of other proportions are refused."""
    export(policy, tmp_path / "exported")
    alone, demo = standalone.Policy(tmp_path / "exported"), demos[0][0]
    large = {"scene": RNG.integers(0, 256, (31, 41, 3), np.uint8), "hand": RNG.integers(0, 256, (20, 20, 3), np.uint8)}
    small = {name: next(resized([image], SIZES[name])) for name, image in large.items()}
    for name, image in large.items():
        assert shrunk(image.shape, SIZES[name][0]) == SIZES[name]
        off = standalone._fitted(image, SIZES[name]).astype(int) - small[name]
        assert np.abs(off).max() <= 1
    learned = alone.adapt(image=demo.image, state=demo.state, action=demo.action)
    expected = policy.adapt(policy.params, demo)
    action = policy.act(expected, Observation(large, demo.state[0]))
    np.testing.assert_array_equal(action, policy.act(expected, Observation(small, demo.state[0])))
    np.testing.assert_allclose(alone.act(learned, image=large, state=demo.state[0]), action, atol=0.02)
    with pytest.raises(ValueError, match=r"image.hand: got shape \[20, 30, 3\]"):
        alone.act(learned, image={**small, "hand": np.zeros((20, 30, 3), np.uint8)}, state=demo.state[0])
    assert alone.metadata == {"fps": 20, "state_names": ["x", "y", "z"], "action_names": ["dx", "dy"]}


@pytest.mark.slow
def test_cameras_that_lack_or_do_not_fit_are_named(policy, demos):
    demo = demos[0][0]
    for image, message in (
        ({"hand": demo.image["hand"]}, "demo.image: got the cameras hand, expected a dictionary of scene, hand"),
        (demo.image["scene"], "demo.image: got ndarray, expected a dictionary of scene, hand"),
        ({**demo.image, "hand": demo.image["scene"]}, r"demo.image.hand: got shape \[6, 12, 16, 3\], expected"),
        ({**demo.image, "hand": demo.image["hand"] / 255.0}, "demo.image.hand: got float64, expected uint8"),
        (None, "demo.image.scene: missing, expected an array"),
    ):
        with pytest.raises(ValueError, match=message):
            policy.adapt(policy.params, dataclasses.replace(demo, image=image))


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ({"a/b": (8, 8), "c": (8, 8)}, r"cameras: got the names \['a/b'\], expected letters"),
        ({}, "cameras: got the names"),
        ({"a": (8, 8)}, r"cameras: got .*, expected \(H, W\): a single camera has no name"),
        ({"a": (8,), "b": (8, 8)}, r"image.a: got the shape \(8,\), expected two whole numbers"),
    ],
)
def test_cameras_without_good_names_or_sizes_are_refused(tmp_path, shape, message):
    with pytest.raises(ValueError, match=message):
        Writer(tmp_path / "set", shape, 3, 2)
