"""The policy that users hold, and what it says to bad demonstrations."""

import dataclasses
import pickle
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import milx
from milx.core.checkpoint import Checkpoints
from milx.data.simulated import render_demo
from milx.deploy.policy import check_demo, check_observation
from milx.methods import params_like

T, H, W, S, A = 5, 32, 40, 8, 2


@pytest.fixture(scope="module")
def policy(trained):
    return milx.load(trained.folder)


@pytest.fixture(scope="module")
def demo(trained):
    """Returns a held-out demonstration, [1, T, ...]."""
    first = jax.tree.map(lambda x: x[0], (trained.test.task, trained.test.states, trained.test.action))
    states, action = jax.tree.map(lambda x: x[0], first[1:])
    seen = jax.jit(lambda *args: render_demo(trained.run.env, *args))(first[0], states, action)
    return jax.tree.map(lambda x: x[None], seen)


@pytest.fixture(scope="module")
def task_params(policy, demo):
    return policy.adapt(policy.params, demo)


def good_demo():
    """Returns [T, ...] NumPy arrays of the right shapes and types."""
    rng = np.random.default_rng(0)
    return milx.Demo(
        image=rng.integers(0, 256, (T, H, W, 3), dtype=np.uint8),
        state=rng.standard_normal((T, S)).astype(np.float32),
        action=rng.uniform(-1, 1, (T, A)).astype(np.float32),
    )


def with_entry(array, index, value):
    array = array.copy()
    array[index] = value
    return array


def test_loaded_parameters_are_those_of_the_best_checkpoint(trained, policy):
    checkpoints = Checkpoints(trained.folder / "checkpoints", read_only=True)
    like = {"params": params_like(policy.method, policy.spec)}
    items, _ = checkpoints.restore(checkpoints.best, like)
    jax.tree.map(np.testing.assert_array_equal, policy.params, items["params"])
    assert policy.config == trained.config


def test_adapt_is_the_method_s(policy, demo, task_params):
    expected = jax.jit(policy.method.adapt)(policy.params, demo)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-5), task_params, expected)
    change = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), task_params["policy"], policy.params["policy"])
    assert max(jax.tree.leaves(change)) > 1e-3, "adaptation changes the parameters by more than the tolerance"


def test_one_demonstration_is_a_set_of_one(policy, demo, task_params):
    single = policy.adapt(policy.params, jax.tree.map(lambda x: x[0], demo))
    jax.tree.map(np.testing.assert_array_equal, single, task_params)


def test_numpy_and_jax_arrays_adapt_alike(policy, demo, task_params):
    numpy = policy.adapt(policy.params, jax.tree.map(np.asarray, demo))
    jax.tree.map(np.testing.assert_array_equal, numpy, task_params)


def test_act_is_the_method_s(policy, demo, task_params):
    for t in (0, 20):
        observation = milx.Observation(image=demo.image[0, t], state=demo.state[0, t])
        expected, _ = policy.method.act(task_params, observation, ())
        np.testing.assert_allclose(policy.act(task_params, observation), expected, rtol=0, atol=1e-5)
    before = policy.act(policy.params, observation)
    assert np.abs(before - expected).max() > 1e-4, "the demonstration matters"


@pytest.fixture(scope="module")
def seen(demo):
    return milx.Observation(*jax.tree.map(lambda x: x[0, 0], (demo.image, demo.state)))


def test_adapt_and_act_are_pure_functions_under_jit(policy, demo, task_params, seen):
    """Adapts and acts inside one program whose inputs are all traced."""

    @jax.jit
    def act(params, demo, seen):
        return policy.act(policy.adapt(params, demo), seen)

    expected = policy.act(task_params, seen)
    np.testing.assert_allclose(act(policy.params, demo, seen), expected, rtol=0, atol=1e-5)


def test_act_under_vmap_is_a_loop(policy, demo, task_params):
    """Acts on all time steps at once; convolutions of several images may round otherwise."""
    frames = milx.Observation(*jax.tree.map(lambda x: x[0, :4], (demo.image, demo.state)))
    at_once = jax.vmap(policy.act, in_axes=(None, 0))(task_params, frames)
    one_by_one = [policy.act(task_params, jax.tree.map(lambda x, i=i: x[i], frames)) for i in range(4)]
    np.testing.assert_allclose(at_once, np.stack(one_by_one), rtol=0, atol=1e-5)


def test_the_gradient_through_adaptation_is_a_finite_difference(policy, demo, seen):
    """Differentiates an action by a bias of the parameters before adaptation, as meta-training does."""
    bias = ["policy", "controller", "Dense_0", "bias"]

    def action(shift):
        params = jax.tree_util.tree_map_with_path(
            lambda path, x: x + shift * jnp.cos(jnp.arange(x.size)) if [key.key for key in path] == bias else x,
            {"policy": policy.params["policy"]},
        )
        return policy.act(policy.adapt(policy.params | params, demo), seen).sum()

    step = 1e-2
    slope = jax.jit(jax.grad(action))(0.0)
    numeric = (action(step) - action(-step)) / (2 * step)
    assert abs(slope) > 1e-3
    np.testing.assert_allclose(slope, numeric, rtol=0.05)


def test_a_pickled_policy_acts_alike(policy, task_params, seen):
    sent = pickle.loads(pickle.dumps(policy))
    assert (sent.config, sent.spec) == (policy.config, policy.spec)
    jax.tree.map(np.testing.assert_array_equal, sent.params, policy.params)
    np.testing.assert_array_equal(sent.act(task_params, seen), policy.act(task_params, seen))


def test_an_action_that_is_not_finite_is_an_error(policy, task_params, seen):
    """Acts with parameters and on a state that are finite, but whose products are not."""
    with pytest.raises(ValueError, match=r"action: got \[.*\], expected finite numbers"):
        policy.act(jax.tree.map(lambda x: x * 1e38, task_params), seen)
    with pytest.raises(ValueError, match=r"action: got \[.*\], expected finite numbers"):
        policy.act(task_params, dataclasses.replace(seen, state=np.full(S, 3e38, np.float32)))


@pytest.mark.parametrize(
    ("given", "needed", "shape"),
    [
        ("video+state", {"image", "state"}, f"[{T}], expected [T, S]"),
        ("video", {"image"}, f"[{T}], expected [T, H, W, 3]"),
    ],
)
def test_what_a_policy_is_not_given_it_does_not_ask_for(policy, given, needed, shape):
    demo = good_demo()
    checked = check_demo(demo, policy.spec, given)
    for field in ("image", "state", "action"):
        value = getattr(checked, field)
        assert (value is not None) == (field in needed)
        if field in needed:
            np.testing.assert_array_equal(value, getattr(demo, field)[None])
            with pytest.raises(ValueError, match=f"demo.{field}: missing"):
                check_demo(dataclasses.replace(demo, **{field: None}), policy.spec, given)
    if "state" in needed:
        np.testing.assert_array_equal(checked.goal, np.tile(demo.state[-1, [4, 5]], (1, T, 1)))
    first = "state" if "state" in needed else "image"
    with pytest.raises(ValueError, match=re.escape(f"demo.{first}: got shape {shape}")):
        check_demo(dataclasses.replace(demo, **{first: np.zeros(T, np.float32)}), policy.spec, given)


BAD_DEMOS = {
    "no action": (lambda d: {"action": None}, "demo.action: missing, expected an array"),
    "no image": (lambda d: {"image": None}, "demo.image: missing, expected an array"),
    "no state": (lambda d: {"state": None}, "demo.state: missing, expected an array"),
    "wrong state size": (
        lambda d: {"state": d.state[:, :6]},
        f"demo.state: got shape [{T}, 6], expected [{T}, {S}]",
    ),
    "wrong action size": (
        lambda d: {"action": np.zeros((T, 3), np.float32)},
        f"demo.action: got shape [{T}, 3], expected [{T}, {A}]",
    ),
    "channels first": (
        lambda d: {"image": np.moveaxis(d.image, -1, 1)},
        f"demo.image: got shape [{T}, 3, {H}, {W}], expected [{T}, {H}, {W}, 3]",
    ),
    "wrong image size": (
        lambda d: {"image": d.image[:, ::2]},
        f"demo.image: got shape [{T}, {H // 2}, {W}, 3], expected [{T}, {H}, {W}, 3]",
    ),
    "float image": (
        lambda d: {"image": d.image / np.float32(255)},
        "demo.image: got float32, expected uint8 in [0, 255]",
    ),
    "signed image": (lambda d: {"image": d.image.astype(np.int8)}, "demo.image: got int8, expected uint8"),
    "NaN state": (
        lambda d: {"state": with_entry(d.state, (3, 1), np.nan)},
        "demo.state: got nan at (3, 1), expected finite numbers",
    ),
    "infinite action": (
        lambda d: {"action": with_entry(d.action, (2, 0), -np.inf)},
        "demo.action: got -inf at (2, 0), expected finite numbers",
    ),
    "action out of range": (
        lambda d: {"action": with_entry(d.action, (2, 1), 1.5)},
        "demo.action: got 1.5 at (2, 1), expected at least -1.0 and at most 1.0",
    ),
    "no time steps": (
        lambda d: {"image": d.image[:0], "state": d.state[:0], "action": d.action[:0]},
        f"demo.action: got shape [0, {A}], expected [T, A] or [K, T, A] with at least one time step",
    ),
    "a state too few": (
        lambda d: {"state": d.state[1:]},
        f"demo.state: got shape [{T - 1}, {S}], expected [{T}, {S}]",
    ),
    "an image too few": (
        lambda d: {"image": d.image[1:]},
        f"demo.image: got shape [{T - 1}, {H}, {W}, 3], expected [{T}, {H}, {W}, 3]",
    ),
    "one set of actions": (lambda d: {"action": d.action[None]}, f"demo.image: got shape [{T}, {H}, {W}, 3]"),
    "no axis of actions": (lambda d: {"action": d.action[:, 0]}, f"demo.action: got shape [{T}], expected [T, A]"),
    "strings": (
        lambda d: {"action": d.action.astype(str)},
        "demo.action: got <U",
    ),
    "complex state": (lambda d: {"state": d.state + 0j}, "demo.state: got complex64, expected real numbers"),
    "objects": (lambda d: {"state": d.state.astype(object)}, "demo.state: got object, expected real numbers"),
    "ragged actions": (lambda d: {"action": [[0.0, 1.0], [2.0]]}, "demo.action: "),
    "ragged states": (lambda d: {"state": [[0.0, 1.0], [2.0]]}, "demo.state: "),
}


@pytest.mark.parametrize("case", BAD_DEMOS)
def test_bad_demonstration_is_refused(policy, case):
    change, message = BAD_DEMOS[case]
    good = good_demo()
    bad = dataclasses.replace(good, **change(good))
    with pytest.raises(ValueError, match="^" + re.escape(message)) as error:
        policy.adapt(policy.params, bad)
    assert "expected" in str(error.value)


def test_something_else_than_a_record_is_refused(policy, task_params):
    with pytest.raises(ValueError, match=r"demo: got dict, expected a milx\.Demo"):
        policy.adapt(policy.params, dataclasses.asdict(good_demo()))
    with pytest.raises(ValueError, match=r"observation: got NoneType, expected a milx\.Observation"):
        policy.act(task_params, None)


def test_the_same_demonstration_without_the_fault_is_accepted(policy):
    good = good_demo()
    adapted = policy.adapt(policy.params, good)
    lists = dataclasses.replace(good, state=good.state.tolist(), action=good.action.astype(np.float64))
    jax.tree.map(np.testing.assert_array_equal, policy.adapt(policy.params, lists), adapted)


BAD_OBSERVATIONS = {
    "no image": ({"image": None}, "observation.image: missing, expected an array"),
    "batched": (
        {"state": np.zeros((1, S), np.float32)},
        f"observation.state: got shape [1, {S}], expected [{S}]",
    ),
    "float image": ({"image": np.zeros((H, W, 3))}, "observation.image: got float64, expected uint8"),
    "NaN": (
        {"state": np.full(S, np.nan, np.float32)},
        "observation.state: got nan at (0,), expected finite numbers",
    ),
}


@pytest.mark.parametrize("case", BAD_OBSERVATIONS)
def test_bad_observation_is_refused(policy, task_params, case):
    change, message = BAD_OBSERVATIONS[case]
    good = milx.Observation(image=np.zeros((H, W, 3), np.uint8), state=np.zeros(S, np.float32))
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        policy.act(task_params, dataclasses.replace(good, **change))


def test_a_policy_without_pixels_takes_none(policy):
    spec = dataclasses.replace(policy.spec, image_shape=None)
    good = good_demo()
    checked = check_demo(dataclasses.replace(good, image=None), spec)
    assert checked.image is None
    np.testing.assert_array_equal(checked.state[0], good.state)
    with pytest.raises(
        ValueError, match=re.escape("demo.image: got ndarray, expected None: this policy sees no pixels")
    ):
        check_demo(good, spec)
    with pytest.raises(ValueError, match=re.escape("observation.image: got ndarray, expected None")):
        check_observation(milx.Observation(good.image[0], good.state[0]), spec)


def test_a_policy_without_states_needs_none(policy):
    spec = dataclasses.replace(policy.spec, state_size=0, goal_indices=())
    checked = check_demo(dataclasses.replace(good_demo(), state=None), spec, "video+state")
    np.testing.assert_array_equal(checked.state, np.zeros((1, T, 0)))
    np.testing.assert_array_equal(checked.image[0], good_demo().image)


def test_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"has no config\.json, expected a folder written by") as error:
        milx.load(tmp_path)
    assert str(tmp_path) in str(error.value)


def test_run_without_a_checkpoint_is_refused(trained, tmp_path):
    (tmp_path / "config.json").write_text((trained.folder / "config.json").read_text())
    with pytest.raises(ValueError, match="no checkpoint yet"):
        milx.load(tmp_path)
