"""The laws of MIL's inner step and of its losses, and of how they are computed."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from mil_cases import (
    ALPHA,
    CONSTANT,
    GOAL_INDICES,
    NO_CLIP,
    STATE,
    STEPS,
    TASKS,
    THETA,
    assert_trees_close,
    build,
    difference,
    random_batch,
    random_demos,
    random_params,
    random_whitening,
)

from milx.meta import steps
from milx.methods.mil import MIL, MILConfig
from milx.networks.goal import Goal
from milx.networks.policy_network import PolicyNetwork
from milx.training import update
from milx.types import Observation


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def batch(float64):
    return random_batch()


@pytest.mark.slow
def test_a_video_teaches_the_goal_that_hindsight_sees_in_its_first_and_last_image(batch):
    """Makes one vote, theta, of deviation one: the inner gradient is the vote minus that goal, whatever the states are.

    The head sees with unadapted parameters in the inner step and in the loss.
    """
    corner = lambda image: image[..., 0, 0, :2] / 255.0  # noqa: E731
    network = PolicyNetwork(
        init=CONSTANT.init,
        apply=lambda theta, image, state, *_: CONSTANT.apply(theta, image, state)._replace(
            goal=Goal(jnp.zeros((len(state), 1)), theta[None], jnp.zeros(())), feature_map=corner(image)[:, None, None]
        ),
        learned_loss=lambda theta, features: jnp.zeros(len(features)),
        hindsight=lambda theta, maps: Goal(
            jnp.zeros((len(maps), 1)), theta + (maps[:, 0] + 3 * maps[:, -1])[:, 0], jnp.asarray(-0.2)
        ),
    )
    config = MILConfig(inner_lr=ALPHA, goal_weight=0.7, inner_clip=NO_CLIP, given="video")
    method = MIL(config, network, GOAL_INDICES)
    params = {"policy": jnp.asarray(THETA), "whitening": random_whitening(np.random.default_rng(4))}
    support = jax.tree.map(lambda x: x[0], batch.support)

    def goal(demo):
        first, last = (np.asarray(corner(demo.image[..., t, :, :, :])) for t in (0, -1))
        return THETA + first + 3 * last

    adapted = method.adapt(params, support)["policy"]
    np.testing.assert_allclose(adapted, THETA - ALPHA * 0.7 * (THETA - goal(support)[0]), rtol=1e-12)

    loss, metrics = method.loss(params, batch)
    indices = np.array(GOAL_INDICES)
    mean, scale = (np.asarray(x)[indices] for x in (params["whitening"].state_mean, params["whitening"].state_scale))
    square = np.sum((goal(batch.query) - (np.asarray(batch.query.goal)[:, :, 0] - mean) / scale) ** 2, axis=-1)
    expected = 0.5 * np.exp(0.4) * square.mean(axis=-1) + np.log(2 * np.pi) - 2 * 0.2
    np.testing.assert_allclose(metrics["hindsight_loss"], expected, rtol=1e-12)
    total = metrics["action_loss"] + 0.7 * (metrics["goal_loss"] + expected)
    np.testing.assert_allclose(loss, total.mean(), rtol=1e-12)
    learned = jax.grad(lambda params: method.loss(params, batch)[0])(params)
    assert all(not np.any(leaf) for leaf in jax.tree.leaves(learned["whitening"]))


def test_goal_head_learns_the_goal_of_each_time_step(batch):
    network = PolicyNetwork(
        init=CONSTANT.init,
        apply=lambda theta, image, state, *_: CONSTANT.apply(theta, image, state)._replace(
            goal=Goal(jnp.zeros((len(state), 1)), jnp.array([[0.5, -2.0]]), jnp.asarray(0.3))
        ),
    )
    method = MIL(MILConfig(goal_weight=0.7), network, GOAL_INDICES)
    whitening = random_whitening(np.random.default_rng(4))
    demo = jax.tree.map(lambda x: x[0], batch.query)
    loss, metrics = method.imitation_loss(jnp.asarray(THETA), whitening, demo)
    indices = np.array(GOAL_INDICES)
    goals = np.asarray((demo.goal - whitening.state_mean[indices]) / whitening.state_scale[indices])
    square = np.mean(np.sum((np.array([0.5, -2.0]) - goals) ** 2, axis=-1))
    expected = 0.5 * np.exp(-0.6) * square + np.log(2 * np.pi) + 2 * 0.3  # of one Gaussian in the plane
    np.testing.assert_allclose(metrics["goal_loss"], expected, rtol=1e-12)
    np.testing.assert_allclose(loss, metrics["action_loss"] + 0.7 * expected, rtol=1e-12)

    half = dataclasses.replace(demo, goal=demo.goal.at[:, ::2].set(jnp.nan))
    _, metrics = method.imitation_loss(jnp.asarray(THETA), whitening, half)
    square = np.mean(np.sum((np.array([0.5, -2.0]) - goals[:, 1::2]) ** 2, axis=-1))
    np.testing.assert_allclose(metrics["goal_loss"], 0.5 * np.exp(-0.6) * square + np.log(2 * np.pi) + 0.6, rtol=1e-12)

    unknown = dataclasses.replace(demo, goal=None)
    loss, metrics = method.imitation_loss(jnp.asarray(THETA), whitening, unknown)
    np.testing.assert_allclose(loss, metrics["action_loss"], rtol=1e-12)


def test_votes_start_from_the_cameras_calibration_in_whitened_units():
    network, _ = random_params(goal_head=True, hindsight_head=True)
    whitening, corner = random_whitening(np.random.default_rng(4)), np.array([0.3, -0.6, 1.0])
    image_to_goal = ((0.4, 0.0), (0.1, -0.2), (0.3, 0.5))
    method = MIL(MILConfig(), network, GOAL_INDICES, image_to_goal)
    policy = jax.jit(method.init)(jax.random.key(0), whitening)["policy"]
    state = np.zeros(STATE)
    state[list(GOAL_INDICES)] = corner @ np.array(image_to_goal)
    for part in ("controller", "hindsight"):
        votes = corner @ np.asarray(policy[part]["goal_head"]["vote"])
        np.testing.assert_allclose(votes, np.asarray(whitening.state(state))[list(GOAL_INDICES)], rtol=1e-6)


# Laws of the inner step.


def test_clip_bounds_every_entry_of_the_step(batch):
    clip = 0.05
    support = jax.tree.map(lambda x: x[0], batch.support)
    steps = []
    for inner_clip in (clip, NO_CLIP):
        method, params = build(inner_clip=inner_clip)
        adapted = jax.jit(method.adapt)(params, support)["policy"]
        steps.append(np.asarray(jax.flatten_util.ravel_pytree(difference(adapted, params["policy"]))[0]) / 0.05)
    clipped, free = steps
    np.testing.assert_allclose(clipped, np.clip(free, -clip, clip), atol=1e-7)
    assert 0.05 < np.mean(np.abs(free) > clip) < 0.95


def test_with_rate_zero_the_loss_is_plain_imitation_of_the_query(batch):
    method, params = build({"heads": 2}, inner_lr=0.0)
    loss, _ = jax.jit(method.loss)(params, batch)
    imitate = jax.jit(method.imitation_loss)
    plain = [
        imitate(params["policy"], params["whitening"], jax.tree.map(lambda x, i=i: x[i], batch.query))[0]
        for i in range(TASKS)
    ]
    np.testing.assert_allclose(loss, np.mean(plain), rtol=1e-6)


def test_a_small_step_lowers_the_inner_loss_by_its_gradients_square(batch):
    """Compares with L(theta - alpha g) = L(theta) - alpha |g|^2 + O(alpha^2)."""
    method, params = build({"heads": 2, "goal_head": True}, inner_lr=1e-6, goal_weight=0.7)
    support = jax.tree.map(lambda x: x[0], batch.support)

    @jax.jit
    def inner_loss(theta):
        return method.imitation_loss(theta, params["whitening"], support, inner=True)[0]

    change = inner_loss(jax.jit(method.adapt)(params, support)["policy"]) - inner_loss(params["policy"])
    square = jax.jit(lambda theta: optax.tree.norm(jax.grad(inner_loss)(theta)))(params["policy"]) ** 2
    np.testing.assert_allclose(change, -1e-6 * square, rtol=1e-3)


def test_adapt_under_vmap_equals_a_loop(batch):
    method, params = build(inner_steps=2)
    together = jax.jit(jax.vmap(method.adapt, in_axes=(None, 0)))(params, batch.support)["policy"]
    adapt = jax.jit(method.adapt)
    for i in range(TASKS):
        alone = adapt(params, jax.tree.map(lambda x, i=i: x[i], batch.support))["policy"]
        assert_trees_close(jax.tree.map(lambda x, i=i: np.asarray(x)[i], together), alone)


@pytest.mark.slow
@pytest.mark.parametrize("tasks_at_once", [1, 2])
def test_meta_gradient_of_a_few_tasks_at_a_time(batch, monkeypatch, tasks_at_once):
    method, params = build()
    images_per_task = STEPS * (1 + 2)
    monkeypatch.setattr(update, "_CPU_IMAGES", tasks_at_once * images_per_task)
    by_few = functools.partial(update.batch_gradient, method.loss)
    assert "scan" in str(jax.make_jaxpr(by_few)(params, batch)), "the tasks are split"
    found, metrics = jax.jit(by_few)(params, batch)
    (loss, each), gradient = jax.jit(jax.value_and_grad(method.loss, has_aux=True))(params, batch)
    assert np.mean(metrics["loss"]) == pytest.approx(float(loss), rel=1e-12)
    np.testing.assert_allclose(metrics["loss"], each["loss"], rtol=1e-12)
    assert_trees_close(found, gradient)


def test_several_demonstrations_give_the_average_of_their_steps():
    method, params = build({"goal_head": True}, learn_inner_lr=True, goal_weight=0.7)
    demos = random_demos(np.random.default_rng(5), 3)
    adapt = jax.jit(method.adapt)
    together = difference(adapt(params, demos)["policy"], params["policy"])
    steps = [
        difference(adapt(params, jax.tree.map(lambda x, k=k: x[k : k + 1], demos))["policy"], params["policy"])
        for k in range(3)
    ]
    assert_trees_close(together, jax.tree.map(lambda *x: sum(x) / 3, *steps))


NOT_SEEN = {"video+state": ("action",), "video": ("action", "state", "goal")}


@pytest.mark.parametrize(("given", "hindsight"), [("video+state", False), ("video", False), ("video", True)])
def test_what_is_not_given_of_a_demonstration_does_not_matter(batch, given, hindsight):
    """Leaves it out or changes it; all else matters, in the inner step of a learned loss as in a context."""
    network = {"learned_loss": "linear", "goal_head": True, "hindsight_head": hindsight}
    method, params = build(network, given=given, goal_weight=0.7)
    demo, other = (jax.tree.map(lambda x, n=n: x[n], batch.support) for n in range(2))
    adapt = jax.jit(method.adapt)
    adapted = adapt(params, demo)
    for field in ("image", "state", "action", "goal"):
        change = difference(adapt(params, dataclasses.replace(demo, **{field: getattr(other, field)})), adapted)
        assert (float(optax.tree.norm(change["policy"])) > 1e-4) == (field not in NOT_SEEN[given]), field
    without = dataclasses.replace(demo, **dict.fromkeys(NOT_SEEN[given]))
    assert_trees_close(adapt(params, without)["policy"], adapted["policy"])
    step = difference(adapted, params)["policy"]
    assert float(optax.tree.norm(step["controller"]["Dense_1"])) == 0, "the actions' layer"
    assert float(optax.tree.norm(step["vision"])) > 1e-4


def test_with_two_heads_the_inner_step_leaves_the_head_that_acts(batch):
    support = jax.tree.map(lambda x: x[0], batch.support)
    moved = {}
    for heads in (1, 2):
        method, params = build({"heads": heads})
        step = difference(jax.jit(method.adapt)(params, support)["policy"], params["policy"])
        parts = {**step.pop("controller"), **step}
        moved[heads] = {layer: float(optax.tree.norm(part)) for layer, part in parts.items()}
    assert moved[2].pop("Dense_2") == 0, "the last layer before the action"
    for heads in (1, 2):
        assert min(moved[heads].values()) > 1e-4, moved[heads]


# Acting.


def test_imitating_its_own_actions_is_without_loss(batch):
    """Checks that `act` undoes the loss's whitening, and uses the head that the outer loss trains."""
    method, params = build({"heads": 2})
    task_params = jax.jit(method.adapt)(params, jax.tree.map(lambda x: x[0], batch.support))
    demo = jax.tree.map(lambda x: x[0], batch.query)
    act = jax.vmap(jax.vmap(lambda image, state: method.act(task_params, Observation(image, state), ())[0]))
    own = dataclasses.replace(demo, action=jax.jit(act)(demo.image, demo.state))
    assert np.abs(own.action - demo.action).max() > 0.1
    for inner, law in ((False, lambda loss: loss < 1e-12), (True, lambda loss: loss > 1e-3)):
        imitation_loss = jax.jit(functools.partial(method.imitation_loss, inner=inner))
        loss, _ = imitation_loss(task_params["policy"], task_params["whitening"], own)
        assert law(loss), f"inner {inner}: {loss}"


@pytest.mark.slow
def test_meta_gradient_is_that_of_reverse_over_reverse(batch, monkeypatch):
    method, params = build(inner_steps=2, inner_clip=0.05, learn_inner_lr=True)
    grads = {}
    for name in ("forward over reverse", "reverse over reverse"):
        grads[name] = jax.jit(jax.grad(lambda params: method.loss(params, batch)[0]))(params)
        monkeypatch.setattr(steps, "gradient", lambda loss, theta, *data, order: jax.grad(loss)(theta, *data))
    found, expected = grads.values()
    assert_trees_close(found["policy"], expected["policy"])
    assert_trees_close(found["inner_log_lr"], expected["inner_log_lr"])


@pytest.mark.slow
def test_mixed_precision_keeps_the_meta_gradient_and_its_type(batch):
    method, params = build(inner_lr=0.01)
    mixed, _ = build({"mixed_precision": True}, inner_lr=0.01)
    exact, rough = (jax.jit(jax.grad(lambda params, m=m: m.loss(params, batch)[0]))(params) for m in (method, mixed))
    flat = [jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(grad["policy"])]) for grad in (exact, rough)]
    assert flat[1].dtype == jnp.float64
    # bfloat16 keeps 8 bits: each product is off by up to 2^-8, and two convolutions follow each other.
    distance = jnp.linalg.norm(flat[1] - flat[0]) / jnp.linalg.norm(flat[0])
    assert 1e-5 < distance < 0.05


@pytest.mark.slow
def test_rematerialization_keeps_the_meta_gradient_and_less_memory(batch):
    (plain, params), (frugal, _) = build(), build({"rematerialise": True})
    found, expected = (jax.jit(jax.grad(lambda p, m=m: m.loss(p, batch)[0]))(params) for m in (frugal, plain))
    assert_trees_close(found["policy"], expected["policy"])

    def kept(method):
        """Bytes that the backward pass of plain imitation waits for, parameters and images included."""
        demo = jax.tree.map(lambda x: x[0], batch.query)
        loss = lambda theta: method.imitation_loss(theta, params["whitening"], demo)[0]  # noqa: E731
        return sum(leaf.nbytes for leaf in jax.tree.leaves(jax.vjp(loss, params["policy"])[1]))

    assert kept(frugal) < 0.5 * kept(plain)
