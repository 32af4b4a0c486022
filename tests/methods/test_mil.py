"""MIL's meta-gradient against finite differences and closed forms, and the laws of its inner step."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from milx.methods import mil
from milx.methods.mil import MIL, MILConfig
from milx.methods.whitening import Whitening
from milx.networks.goal import Goal
from milx.networks.policy_network import PolicyConfig, PolicyNetwork, PolicyOutput, make_policy
from milx.training import update
from milx.types import Demo, Observation, TaskBatch

IMAGE_SHAPE, STATE, ACTION, TASKS, STEPS = (8, 10), 4, 2, 3, 5
GOAL_INDICES = (1, 3)
TINY = {"filters": (4, 4), "strides": (2, 2), "fc_layers": (8,), "bias_transformation": 3}
NO_CLIP = 1e9


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


def random_demos(rng, *shape):
    """Demonstrations with leading axes `shape`."""
    return Demo(
        image=jnp.asarray(rng.integers(0, 256, (*shape, STEPS, *IMAGE_SHAPE, 3), dtype=np.uint8)),
        state=jnp.asarray(rng.standard_normal((*shape, STEPS, STATE))),
        action=jnp.asarray(rng.standard_normal((*shape, STEPS, ACTION))),
        goal=jnp.asarray(rng.standard_normal((*shape, STEPS, len(GOAL_INDICES)))),
    )


def random_whitening(rng):
    return Whitening(
        state_mean=jnp.asarray(rng.standard_normal(STATE)),
        state_scale=jnp.asarray(rng.uniform(0.5, 2, STATE)),
        action_mean=jnp.asarray(rng.standard_normal(ACTION)),
        action_scale=jnp.asarray(rng.uniform(0.5, 2, ACTION)),
    )


@pytest.fixture(scope="module")
def batch():
    rng = np.random.default_rng(0)
    return TaskBatch(support=random_demos(rng, TASKS, 1), query=random_demos(rng, TASKS, 2))


@functools.cache
def random_params(**network):
    """A tiny network and parameters that are nowhere zero."""
    policy = make_policy(PolicyConfig(**TINY | network), IMAGE_SHAPE, STATE, ACTION, len(GOAL_INDICES))
    rng = np.random.default_rng(1)
    draw = lambda leaf: jnp.asarray(leaf + 0.2 * rng.standard_normal(leaf.shape))  # noqa: E731
    return policy, jax.tree.map(draw, jax.jit(policy.init)(jax.random.key(0)))


def build(network=None, **config):
    """MIL on a tiny network, and its parameters."""
    policy, theta = random_params(**network or {})
    rng = np.random.default_rng(2)
    params = {"policy": theta, "whitening": random_whitening(rng)}
    if config.get("learn_inner_lr"):
        params["inner_log_lr"] = jax.tree.map(lambda _: jnp.asarray(0.3 * rng.standard_normal()), theta)
    return MIL(MILConfig(**{"inner_lr": 0.05, "inner_clip": NO_CLIP} | config), policy, GOAL_INDICES), params


def assert_trees_close(found, expected):
    """Equal up to 1e-6 of each tensor's largest entry: images enter in float32, which two programs may round apart."""
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=1e-6 * np.abs(b).max())  # noqa: E731
    jax.tree.map(close, found, expected)


def difference(after, before):
    return jax.tree.map(lambda a, b: a - b, after, before)


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


@pytest.mark.parametrize("variant", VARIANTS)
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
        expected = sum(jax.tree.leaves(jax.tree.map(jnp.vdot, gradient[name], direction)))
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
    change = optax.tree.norm(difference(second_order["policy"], expected)) / optax.tree.norm(expected)
    assert change > 0.01, "second derivatives matter here"


def test_no_gradient_reaches_the_whitening_and_adam_leaves_it(batch):
    method, params = build()
    gradient = jax.jit(jax.grad(lambda params: method.loss(params, batch)[0]))(params)
    assert optax.tree.norm(gradient["policy"]) > 0.01
    optimizer = optax.adam(1e-3)
    updates, _ = optimizer.update(gradient, optimizer.init(params), params)
    after = optax.apply_updates(params, updates)
    for name, value in dataclasses.asdict(params["whitening"]).items():
        np.testing.assert_array_equal(getattr(gradient["whitening"], name), 0)
        np.testing.assert_array_equal(getattr(after["whitening"], name), value)


# A policy whose action is its parameter: everything has a closed form.
#
# With m the loss scale, A the size of the action, a and b the whitened support's and query's mean actions, an inner
# gradient is 2 m^2 / A (theta - a), so that n steps shrink theta - a by c^n with c = 1 - 2 alpha m^2 / A.

CONSTANT = PolicyNetwork(
    init=lambda key: jnp.zeros(ACTION),
    apply=lambda theta, image, state, *_: PolicyOutput(
        *[jnp.broadcast_to(theta, (len(state), ACTION))] * 2, goal=None, feature_map=None, features=state
    ),
)
THETA = np.array([0.4, -1.3])
ALPHA, M = 0.1, 1.7
SLOPE = 2 * M**2 / ACTION


def constant_mil(**config):
    return MIL(MILConfig(**{"inner_lr": ALPHA, "loss_scale": M, "inner_clip": NO_CLIP} | config), CONSTANT)


@pytest.fixture(scope="module")
def constant_case(batch):
    """Parameters, the batch without images, and the mean whitened actions of support and query [TASKS, A]."""
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

    (loss, metrics), gradient = jax.value_and_grad(method.loss, has_aux=True)(params, batch)
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
    """Where the clip holds, the step is alpha times the clip and no longer depends on theta: the factor is one."""
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


def test_a_video_teaches_the_goal_that_hindsight_sees_in_its_first_and_last_image(batch):
    """One vote, theta, of deviation one: the inner gradient is the vote minus that goal, whatever the states are.

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
    policy = method.init(jax.random.key(0), whitening)["policy"]
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
    """L(theta - alpha g) = L(theta) - alpha |g|^2 + O(alpha^2)."""
    method, params = build({"heads": 2, "goal_head": True}, inner_lr=1e-6, goal_weight=0.7)
    support = jax.tree.map(lambda x: x[0], batch.support)

    @jax.jit
    def inner_loss(theta):
        return method.imitation_loss(theta, params["whitening"], support, inner=True)[0]

    change = inner_loss(jax.jit(method.adapt)(params, support)["policy"]) - inner_loss(params["policy"])
    square = optax.tree.norm(jax.jit(jax.grad(inner_loss))(params["policy"])) ** 2
    np.testing.assert_allclose(change, -1e-6 * square, rtol=1e-3)


def test_adapt_under_vmap_equals_a_loop(batch):
    method, params = build(inner_steps=2)
    together = jax.jit(jax.vmap(method.adapt, in_axes=(None, 0)))(params, batch.support)["policy"]
    adapt = jax.jit(method.adapt)
    for i in range(TASKS):
        alone = adapt(params, jax.tree.map(lambda x, i=i: x[i], batch.support))["policy"]
        assert_trees_close(jax.tree.map(lambda x, i=i: x[i], together), alone)


@pytest.mark.parametrize("tasks_at_once", [1, 2])
def test_meta_gradient_of_a_few_tasks_at_a_time(batch, monkeypatch, tasks_at_once):
    method, params = build()
    images_per_task = STEPS * (1 + 2)
    monkeypatch.setattr(update, "_CPU_IMAGES", tasks_at_once * images_per_task)
    by_few = functools.partial(update.meta_gradient, method.loss)
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
    """Nor need it be there; all else matters, in the inner step of a learned loss as in a context."""
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
    """`act` undoes the whitening that the loss applies, and uses the head that the outer loss trains."""
    method, params = build({"heads": 2})
    task_params = jax.jit(method.adapt)(params, jax.tree.map(lambda x: x[0], batch.support))
    demo = jax.tree.map(lambda x: x[0], batch.query)
    act = jax.vmap(jax.vmap(lambda image, state: method.act(task_params, Observation(image, state), ())[0]))
    own = dataclasses.replace(demo, action=jax.jit(act)(demo.image, demo.state))
    assert np.abs(own.action - demo.action).max() > 0.1
    for inner, law in ((False, lambda loss: loss < 1e-12), (True, lambda loss: loss > 1e-3)):
        loss, _ = method.imitation_loss(task_params["policy"], task_params["whitening"], own, inner=inner)
        assert law(loss), f"inner {inner}: {loss}"


def test_meta_gradient_is_that_of_reverse_over_reverse(batch, monkeypatch):
    method, params = build(inner_steps=2, inner_clip=0.05, learn_inner_lr=True)
    grads = {}
    for name in ("forward over reverse", "reverse over reverse"):
        grads[name] = jax.jit(jax.grad(lambda params: method.loss(params, batch)[0]))(params)
        monkeypatch.setattr(mil, "gradient", lambda loss, theta, *data: jax.grad(loss)(theta, *data))
    found, expected = grads.values()
    assert_trees_close(found["policy"], expected["policy"])
    assert_trees_close(found["inner_log_lr"], expected["inner_log_lr"])


def test_mixed_precision_keeps_the_meta_gradient_and_its_type(batch):
    method, params = build(inner_lr=0.01)
    mixed, _ = build({"mixed_precision": True}, inner_lr=0.01)
    exact, rough = (jax.jit(jax.grad(lambda params, m=m: m.loss(params, batch)[0]))(params) for m in (method, mixed))
    flat = [jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(grad["policy"])]) for grad in (exact, rough)]
    assert flat[1].dtype == jnp.float64
    # bfloat16 keeps 8 bits: each product is off by up to 2^-8, and two convolutions follow each other.
    distance = jnp.linalg.norm(flat[1] - flat[0]) / jnp.linalg.norm(flat[0])
    assert 1e-5 < distance < 0.05


def test_rematerialisation_keeps_the_meta_gradient_and_less_memory(batch):
    (plain, params), (frugal, _) = build(), build({"rematerialise": True})
    found, expected = (jax.jit(jax.grad(lambda p, m=m: m.loss(p, batch)[0]))(params) for m in (frugal, plain))
    assert_trees_close(found["policy"], expected["policy"])

    def kept(method):
        """Bytes that the backward pass of plain imitation waits for, parameters and images included."""
        demo = jax.tree.map(lambda x: x[0], batch.query)
        loss = lambda theta: method.imitation_loss(theta, params["whitening"], demo)[0]  # noqa: E731
        return sum(leaf.nbytes for leaf in jax.tree.leaves(jax.vjp(loss, params["policy"])[1]))

    assert kept(frugal) < 0.5 * kept(plain)
