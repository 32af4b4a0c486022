"""The mean over tasks, the weights of steps, and implicit derivatives, against closed forms, in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx import meta

RNG = np.random.default_rng(2)
ROOT = RNG.normal(size=(4, 4))
MATRIX = ROOT @ ROOT.T / 4 + np.eye(4)
START = {"a": RNG.normal(size=3), "b": RNG.normal(size=())}
SUPPORT, QUERY = RNG.normal(size=(2, 6, 4))


def flat(theta):
    return jnp.append(theta["a"], theta["b"])


def bowl(theta, center):
    return 0.5 * (flat(theta) - center) @ MATRIX @ (flat(theta) - center)


def task_loss(theta, task):
    support, query = task
    return bowl(meta.adapt(bowl, theta, support, steps=2, rate=0.1), query)


@pytest.mark.parametrize("at_once", [None, 1, 4, 6, 9])
def test_the_meta_gradient_is_the_mean_of_the_tasks_however_many_are_worked_on_at_once(at_once):
    found, losses = jax.jit(lambda theta: meta.meta_gradient(task_loss, theta, (SUPPORT, QUERY), at_once))(START)
    each = [jax.value_and_grad(task_loss)(START, task) for task in zip(SUPPORT, QUERY, strict=True)]
    np.testing.assert_allclose(losses, [loss for loss, _ in each], rtol=1e-12)
    for name in START:
        np.testing.assert_allclose(found[name], np.mean([grad[name] for _, grad in each], axis=0), rtol=1e-12)


@pytest.mark.parametrize("at_once", [None, 2])
def test_what_a_task_tells_beside_its_loss_is_returned_for_each(at_once):
    def telling(theta, task):
        return task_loss(theta, task), {"distance": flat(theta) - task[1]}

    expected = meta.meta_gradient(task_loss, START, (SUPPORT, QUERY))
    compute = jax.jit(lambda theta: meta.meta_gradient(telling, theta, (SUPPORT, QUERY), at_once, has_aux=True))
    gradient, (losses, told) = compute(START)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), (gradient, losses), expected)
    np.testing.assert_allclose(told["distance"], flat(START) - QUERY, rtol=1e-12)


def test_few_tasks_at_once_are_added_up_in_single_precision_at_least():
    """A sum in bfloat16 would stop growing at 256."""
    found, _ = meta.meta_gradient(lambda p, x: (p * x).astype(float), jnp.bfloat16(1), jnp.ones(1024, jnp.bfloat16), 1)
    assert found.dtype == jnp.bfloat16
    assert found == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((task_loss, START, (SUPPORT, QUERY), 0), "at_once: got 0, expected at least 1, or None"),
        ((task_loss, START, (SUPPORT, QUERY[:3])), r"tasks: got the leading axes \[\(3,\), \(6,\)\], expected one of"),
        ((task_loss, START, (SUPPORT[:0], QUERY[:0])), r"tasks: got the leading axes \[\(0,\)\], expected one of"),
        (
            (lambda p, t: flat(p), START, (SUPPORT, QUERY)),
            r"task_loss: got what has the shape \(4,\), expected a scalar",
        ),
        ((task_loss, START, (SUPPORT, QUERY), None, True), "task_loss: got no pair, expected one with has_aux"),
    ],
)
def test_tasks_that_do_not_fit_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        meta.meta_gradient(*arguments)


@pytest.mark.parametrize(
    ("progress", "weights"), [(0, [1 / 3, 1 / 3, 1 / 3]), (1, [0, 0, 1]), (0.4, [0.2, 0.2, 0.6]), (0.4, [1])]
)
def test_the_weights_of_steps_move_to_the_last(progress, weights):
    losses = jnp.asarray(RNG.normal(size=len(weights)))
    np.testing.assert_allclose(meta.multi_step_loss(losses, progress), losses @ np.array(weights), rtol=1e-12)


def test_implicit_adaptation_finds_the_regularized_minimum_and_its_derivative():
    """phi = (A + lambda I)^-1 (A c + lambda theta), and d phi / d theta = lambda (A + lambda I)^-1."""
    strength = 0.7

    def query(theta):
        phi = meta.implicit_adapt(bowl, theta, SUPPORT[0], steps=200, rate=0.3, strength=strength)
        return bowl(phi, QUERY[0]), phi

    found, phi = jax.jit(jax.grad(query, has_aux=True))(START)
    regularized = MATRIX + strength * np.eye(4)
    minimum = np.linalg.solve(regularized, MATRIX @ SUPPORT[0] + strength * flat(START))
    np.testing.assert_allclose(flat(phi), minimum, rtol=1e-8)
    expected = strength * np.linalg.solve(regularized, MATRIX @ (minimum - QUERY[0]))
    np.testing.assert_allclose(flat(found), expected, rtol=1e-7)


def test_implicit_and_unrolled_derivatives_agree_where_steps_converge():
    """Not on a bowl: the loss has a third derivative."""

    def steep(theta, center):
        return bowl(theta, center) + jnp.sum(jnp.cosh(flat(theta) - center))

    def near(theta, origin, center):
        return steep(theta, center) + 0.5 * jnp.sum(jnp.square(flat(theta) - flat(origin)))

    def implicit(theta):
        return bowl(meta.implicit_adapt(steep, theta, SUPPORT[0], steps=300, rate=0.1, strength=1.0), QUERY[0])

    def unrolled(theta):
        order = "reverse_over_reverse"  # which differentiates by the origin, too
        return bowl(meta.adapt(near, theta, theta, SUPPORT[0], steps=300, rate=0.1, order=order), QUERY[0])

    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-7), jax.grad(implicit)(START), jax.grad(unrolled)(START)
    )


def test_tasks_are_adapted_implicitly_side_by_side_in_types_of_their_own():
    """Of two types, with rates of every tensor, and in single precision within its rounding."""

    def implicit(theta, task):
        rates = {"a": 0.2, "b": 0.1}
        found = meta.implicit_adapt(bowl, theta, task[0], steps=200, rate=rates, strength=0.7)
        return bowl(found, task[1])

    exact, _ = meta.meta_gradient(implicit, START, (SUPPORT, QUERY))
    mixed = {"a": jnp.asarray(START["a"], jnp.float32), "b": jnp.asarray(START["b"])}
    found, _ = meta.meta_gradient(implicit, mixed, (SUPPORT, QUERY), 2)
    for name in START:
        assert found[name].dtype == mixed[name].dtype
        np.testing.assert_allclose(found[name], exact[name], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"strength": 0}, "strength: got 0, expected more than 0"),
        ({"strength": np.nan}, "strength: got nan, expected more than 0"),
        ({"strength": 1.0, "iterations": 0}, "iterations: got 0, expected at least 1"),
    ],
)
def test_settings_of_implicit_adaptation_that_do_not_fit_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        meta.implicit_adapt(bowl, START, SUPPORT[0], steps=1, rate=0.1, **settings)


def wide(w, x):
    """Needs much memory for every task."""
    return jnp.square(jnp.tanh(jnp.tanh(x[:, None] * w) @ w)).sum()


def summed(w, x):
    """Needs none for all tasks at once, where nothing is added up in a scan."""
    return jnp.square(w).sum() * x.sum() + (jnp.tanh(w) * x.sum()).sum()


def telling(w, x):
    return wide(w, x), x


@pytest.mark.parametrize(
    ("loss", "has_aux", "sizes"),
    [(wide, False, (50, 12, 400)), (telling, True, (50, 12, 400)), (summed, False, (10_000, 4, 3))],
)
def test_as_many_tasks_are_worked_on_at_once_as_memory_allows(loss, has_aux, sizes):
    w, x = RNG.normal(size=sizes[0]), RNG.normal(size=sizes[1:])
    needed = {}
    for at_once in (n for n in range(1, len(x) + 1) if len(x) % n == 0):
        lowered = jax.jit(lambda w, x, n=at_once: meta.meta_gradient(loss, w, x, n, has_aux)).lower(w, x)
        needed[at_once] = lowered.compile().memory_analysis().temp_size_in_bytes
    assert len(set(needed.values())) > 1
    for memory in (*needed.values(), max(needed.values()) * 2):
        most = max(n for n, least in needed.items() if least <= memory)
        assert meta.tasks_within(memory, loss, w, x, has_aux) == most
    least = min(needed.values()) - 1
    with pytest.raises(ValueError, match=rf"memory: got {least:,} bytes, expected at least {needed[1]:,}, which one"):
        meta.tasks_within(least, loss, *jax.eval_shape(lambda *a: a, w, x), has_aux)


def test_tasks_of_which_there_are_several_numbers_have_no_bound():
    with pytest.raises(ValueError, match=r"tasks: got the leading axes \[\(3,\), \(6,\)\], expected one of at least 1"):
        meta.tasks_within(10**9, task_loss, START, (SUPPORT, QUERY[:3]))
