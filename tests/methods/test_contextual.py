"""Every method learns from a demonstration what no observation tells, and contexts keep what they promise."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from milx import methods
from milx.config import assemble
from milx.methods.whitening import Whitening
from milx.types import Demo, Observation, Spec, TaskBatch

IMAGE_SHAPE, STATE, ACTION, STEPS = (8, 10), 7, 2, 5
OBJECTS = ((1, 2), (3, 4), (5, 6))
CASES = [(name, True) for name in ("mil", "contextual", "lstm")]
CASES += [(name, False) for name in ("mil", "contextual", "lstm", "lstm_attention")]


@functools.cache
def build(name, vision, goal_head=False):
    """Makes a tiny method that sees pixels or only states, and its parameters; whitening changes nothing."""
    spec = Spec(
        image_shape=IMAGE_SHAPE if vision else None,
        state_size=STATE,
        action_size=ACTION,
        action_range=((-1.0,) * ACTION, (1.0,) * ACTION),
        goal_indices=(1, 2) if goal_head else (),
        image_to_goal=((0.5, 0.0), (0.0, -0.5), (0.1, 0.2)) if goal_head and vision else None,
        object_indices=() if vision else OBJECTS,
    )
    config = assemble.default_config(name)
    sizes = {"fc_layers": (16, 16)}
    if name != "lstm_attention":
        sizes |= {"filters": (4,) * vision, "strides": (2,) * vision, "goal_head": goal_head}
    settings = {f"network.{field}": value for field, value in sizes.items()} | {"method.goal_weight": 1.0}
    if name == "mil":
        settings |= {"network.bias_transformation": 4, "method.inner_lr": 0.1, "method.learn_inner_lr": True}
    else:
        settings["network.context"] = 8
    for field, value in settings.items():
        assemble.assign(config, field, value)
    method = methods.make(config, spec)
    zeros, ones = (fill((size,)) for fill, size in ((jnp.zeros, STATE), (jnp.ones, STATE)))
    whitening = Whitening(zeros, ones, jnp.zeros(ACTION), jnp.ones(ACTION))
    return method, jax.jit(method.init)(jax.random.key(0), whitening)


def random_demos(rng, vision, *shape):
    """Samples demonstrations with leading axes `shape`."""
    image = rng.integers(0, 256, (*shape, STEPS, *IMAGE_SHAPE, 3), dtype=np.uint8) if vision else None
    state, action = (rng.standard_normal((*shape, STEPS, size)).astype(np.float32) for size in (STATE, ACTION))
    return jax.tree.map(jnp.asarray, Demo(image, state, action, goal=state[..., 1:3]))


@functools.cache
def two_tasks(vision):
    """Makes two tasks with different demonstrations; the queries show the same, but ask for other actions."""
    rng = np.random.default_rng(0)
    support, query = random_demos(rng, vision, 2, 1), random_demos(rng, vision, 2, 1)
    same = jax.tree.map(lambda x: jnp.stack([x[0], x[0]]), query)
    return TaskBatch(support, dataclasses.replace(same, action=query.action))


@functools.cache
def trained(name, vision):
    """Fits the parameters to the two tasks."""
    method, params = build(name, vision)
    batch, optimizer = two_tasks(vision), optax.adam(3e-3)

    def update(carry, _):
        params, state = carry
        gradient = jax.grad(lambda params: method.loss(params, batch)[0])(params)
        updates, state = optimizer.update(gradient, state)
        return (optax.apply_updates(params, updates), state), None

    fit = jax.jit(lambda carry: jax.lax.scan(update, carry, length=600)[0])
    return fit((params, optimizer.init(params)))[0]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "vision"), CASES)
def test_a_method_fits_two_tasks_and_with_swapped_demonstrations_does_the_other(name, vision):
    """Compares with a blind policy, which errs by a quarter of the tasks' squared difference.

    Fitted, it errs by nothing; told the other task, it does the other, and errs by the whole difference.
    """
    method, _ = build(name, vision)
    batch = two_tasks(vision)
    swapped = dataclasses.replace(batch, support=jax.tree.map(lambda x: x[::-1], batch.support))
    loss = jax.jit(lambda batch: method.loss(trained(name, vision), batch)[0])
    difference = float(jnp.square(batch.query.action[0] - batch.query.action[1]).mean())
    assert loss(batch) < 0.02 * difference / 4
    np.testing.assert_allclose(loss(swapped), difference, rtol=0.3)


@pytest.mark.parametrize(("name", "vision"), CASES)
def test_the_action_is_the_one_that_the_loss_knows(name, vision):
    """Compares the errors of the actions that `adapt` and `act` choose with `loss`."""
    method, params = build(name, vision)
    batch = two_tasks(vision)

    @jax.jit
    def error(support, query):
        task_params = method.adapt(params, support)
        act = jax.vmap(lambda image, state: method.act(task_params, Observation(image, state), ())[0])
        action = act(*jax.tree.map(lambda x: x[0], (query.image, query.state)))
        return jnp.square(action - query.action[0]).mean()

    each = [error(*jax.tree.map(lambda x, n=n: x[n], (batch.support, batch.query))) for n in range(2)]
    np.testing.assert_allclose(np.mean(each), jax.jit(method.loss)(params, batch)[0], rtol=1e-5)


@pytest.mark.parametrize(("name", "vision"), [("contextual", True), ("lstm", False), ("lstm_attention", False)])
def test_several_demonstrations_give_the_mean_of_their_actions(name, vision):
    method, params = build(name, vision)
    demos = random_demos(np.random.default_rng(1), vision, 3)
    seen = jax.tree.map(lambda x: x[0, 0], demos)
    act = jax.jit(lambda demo: method.act(method.adapt(params, demo), Observation(seen.image, seen.state), ())[0])
    each = [act(jax.tree.map(lambda x, k=k: x[k : k + 1], demos)) for k in range(3)]
    assert np.ptp(each, axis=0).min() > 1e-3
    np.testing.assert_allclose(act(demos), np.mean(each, axis=0), atol=1e-6)


@pytest.mark.parametrize(("given", "unseen"), [("video+state", ("action",)), ("video", ("action", "state"))])
@pytest.mark.parametrize("name", ["contextual", "lstm"])
def test_what_is_not_given_of_a_demonstration_does_not_matter(name, given, unseen):
    method, params = build(name, True)
    method = dataclasses.replace(method, config=dataclasses.replace(method.config, given=given))
    demo, other = random_demos(np.random.default_rng(4), True, 1), random_demos(np.random.default_rng(5), True, 1)
    encode = jax.jit(lambda demo: method.adapt(params, demo)["context"])
    context, seen = encode(demo), {"image", "state"} if name == "contextual" else {"image", "state", "action"}
    for field in ("image", "state", "action"):
        change = jnp.abs(encode(dataclasses.replace(demo, **{field: getattr(other, field)})) - context).max()
        assert (change > 1e-5) == (field in seen - set(unseen)), field
    np.testing.assert_array_equal(encode(dataclasses.replace(demo, **dict.fromkeys(unseen))), context)


def test_contextual_policies_see_the_last_frame_only_and_recurrent_ones_all():
    demo = random_demos(np.random.default_rng(2), True, 1)
    for name, frames_seen in (("contextual", [STEPS - 1]), ("lstm", list(range(STEPS)))):
        method, params = build(name, True)
        encode = jax.jit(lambda demo, method=method, params=params: method.adapt(params, demo)["context"])
        context = encode(demo)
        changed = [
            float(jnp.abs(encode(dataclasses.replace(demo, image=demo.image.at[:, t].set(0))) - context).max())
            for t in range(STEPS)
        ]
        assert [t for t in range(STEPS) if changed[t] > 1e-6] == frames_seen, name


@pytest.mark.parametrize("vision", [True, False])
@pytest.mark.parametrize("name", ["contextual", "lstm"])
def test_the_context_tells_the_goal_head_what_to_look_for(name, vision):
    method, params = build(name, vision, goal_head=True)
    demos = random_demos(np.random.default_rng(3), vision, 2, 1)
    seen = jax.tree.map(lambda x: x[0, 0], demos)

    @jax.jit
    def goal(demo):
        context = jax.tree.map(lambda x: x[0], method.adapt(params, demo)["context"])
        return method.network.apply(params, context, seen.image, seen.state).goal

    goals = [goal(jax.tree.map(lambda x, k=k: x[k], demos)) for k in range(2)]
    assert jnp.abs(jnp.exp(goals[0].log_weight) - jnp.exp(goals[1].log_weight)).max() > 1e-3
    np.testing.assert_array_equal(goals[0].vote, goals[1].vote)
    if vision:  # centers of the four by five cells, through the calibration
        x, y = np.meshgrid([-0.8, -0.4, 0, 0.4, 0.8], [-0.75, -0.25, 0.25, 0.75])
        expected = np.stack([0.5 * x.ravel() + 0.1, -0.5 * y.ravel() + 0.2], axis=-1)
        np.testing.assert_allclose(goals[0].vote, expected, atol=1e-6)


def test_attention_to_objects_that_nobody_tells_of_is_refused():
    spec = Spec(None, STATE, ACTION, ((-1.0,) * ACTION, (1.0,) * ACTION), goal_indices=(1,))
    config = assemble.default_config("lstm_attention")
    with pytest.raises(ValueError, match="method: got 'lstm_attention', expected another: the state does not tell"):
        methods.make(config, spec)


@pytest.mark.parametrize(
    ("vision", "given", "learned", "message"),
    [
        (True, "video+actions", None, r"method\.given: got 'video\+actions', expected one of video\+state\+action"),
        (False, "video", "linear", r"method\.given: got 'video', expected the state, too: this policy sees no pixels"),
        (True, "video", "cubic", r"network\.learned_loss: got 'cubic', expected None or one of linear, temporal"),
        (True, "video", None, r"network\.learned_loss: got None with method\.given='video', expected one of linear"),
        (
            True,
            "video+state+action",
            "linear",
            r"network\.learned_loss: got 'linear' .* expected None: the actions",
        ),
    ],
)
def test_demonstrations_that_show_too_little_are_refused(vision, given, learned, message):
    sizes = (STATE, ACTION, ((-1.0,) * ACTION, (1.0,) * ACTION))
    spec = Spec((32, 40) if vision else None, *sizes, goal_indices=(1,))
    config = assemble.default_config("mil")
    config.network.learned_loss, config.method.given = learned, given
    with pytest.raises(ValueError, match=message):
        methods.make(config, spec)


@pytest.mark.parametrize(("given", "goal_head"), [("video", False), ("video+state", True)])
def test_a_hindsight_head_without_use_is_refused(given, goal_head):
    spec = Spec((32, 40), STATE, ACTION, ((-1.0,) * ACTION, (1.0,) * ACTION), goal_indices=(1,))
    config = assemble.default_config("mil")
    config.network.learned_loss, config.network.goal_head, config.network.hindsight_head = "linear", goal_head, True
    config.method.given = given
    with pytest.raises(ValueError, match=r"network\.hindsight_head: got True, expected False: it is for a goal head"):
        methods.make(config, spec)
