"""The planner by sampling on a cart, whose world is a few lines: what it begins with, executes and records."""

import dataclasses
import functools
import types

import cart_laws
import jax
import jax.numpy as jnp
import numpy as np
import planned
import pytest

from milx.core.batching import map_in_chunks
from milx.envs.base import State
from milx.trajopt import demonstrations, planner, receding, sampling
from milx.trajopt.expert import VERSION
from milx.trajopt.planner import Planner, Plans, Settings
from milx.trajopt.sampling import Options

NOISE = 0.05
SETTINGS = Settings(
    scenes=6,
    from_nothing=5,
    search=Options("cross_entropy", samples=16, iterations=3, elites=4, order=1),
    again=Options("predictive", samples=8, order=1),
    every=5,
    knots=4,
    tried=2,
)


@pytest.fixture(scope="module")
def plans(cart):
    return demonstrations.find_plans(cart, SETTINGS, NOISE, jax.random.key(0), 4)


def cost(cart, task, start, knots):
    """Rolls a plan out in the approximation, in a loop."""
    controls = np.stack([np.interp(np.arange(12), np.linspace(0, 11, 4), row) for row in knots.T], axis=1)
    total, state = 0.0, start
    for t, u in enumerate(np.clip(controls, -2, 2)):
        action = jnp.asarray(u / 2)
        total += 0.5 * float(jnp.square(cart.running_residual(task, state, action, t)).sum())
        state = cart.approximate_step(task, state, action)
    return total + 0.5 * float(jnp.square(cart.terminal_residual(task, state)).sum())


def test_a_search_begins_with_the_cheapest_plan_of_the_nearest_scenes_where_one_succeeded(cart, scenes):
    rng = np.random.default_rng(0)
    success = np.array([True, False, True, True, False, True])
    plans = Plans(rng.normal(size=(6, 2)), rng.uniform(-1, 1, (6, 4, 1)), success)
    begin = jax.jit(Planner(cart, SETTINGS).begin_from)
    for task, start in zip(scenes[0][:5], scenes[1].qpos[:5], strict=True):
        state = State(start, jnp.zeros(1), jnp.zeros((0, 3)))
        distance = np.linalg.norm(plans.features - np.array([float((start - task)[0]), 0.0]), axis=1)
        near = [i for i in np.argsort(distance) if success[i]][:2]
        costs = [cost(cart, task, state, plans.knots[i]) for i in near]
        search = begin(task, state, plans)
        np.testing.assert_allclose(search.knots, plans.knots[near[np.argmin(costs)]], rtol=1e-6)
        np.testing.assert_allclose(search.cost, min(costs), rtol=1e-4)
        np.testing.assert_allclose(search.deviation, 0.3 * 0.5, rtol=1e-6)


def test_a_search_never_begins_with_a_plan_that_failed_while_there_is_one_that_succeeded(cart, scenes):
    """The only plan that succeeded is far away and costs more than the others."""
    task, start = jax.tree.map(lambda x: x[0], scenes[:2])
    knots = np.zeros((6, 4, 1))
    knots[4] = -2.0
    plans = Plans(np.zeros((6, 2)) + 5 * np.eye(6)[:, 4:5], knots, np.arange(6) == 4)
    search = Planner(cart, SETTINGS).begin_from(task, start, plans)
    np.testing.assert_allclose(search.knots, knots[4])
    assert search.cost > cost(cart, task, start, knots[0])


@pytest.mark.parametrize("scene", [2, 5])
def test_plans_belong_to_their_scenes(cart, plans, scene):
    """Draws a scene of the first batch of four or of the second again, and searches there alone."""
    task_key, scene_key, search_key, _ = jax.random.split(jax.random.split(jax.random.key(0), 6)[scene], 4)
    task = cart.sample_task(task_key, "train")
    start = cart.reset(scene_key, task)
    np.testing.assert_allclose(plans.features[scene], [float((start.qpos - task)[0]), 0.0], atol=1e-6)
    alone = Planner(cart, SETTINGS)
    search = alone.begin()
    for number in (0, 1):  # five iterations, in searches of three
        search = alone.improve(task, start, search, jax.random.fold_in(search_key, number), 3)
    np.testing.assert_allclose(plans.knots[scene], search.knots, atol=1e-4)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"every": 0}, "every: got 0, expected at least 1"),
        ({"rounds": -1}, "rounds: got -1, expected at least 0"),
        ({"near": 0.0}, r"near: got 0\.0, expected more than 0"),
        ({"again": Options(order=3)}, r"again\.order: got 3, expected search\.order = 1"),
    ],
)
def test_settings_that_make_no_sense_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(SETTINGS, **changes)


def test_plans_are_found_and_demonstrations_begin_with_them(cart, scenes, plans):
    assert plans.success.sum() >= 5
    task, start, keys = scenes
    states, _ = demonstrations.demonstrate(cart, SETTINGS, plans, NOISE, task, start, keys)
    assert jax.vmap(cart.success)(task, states).mean() > 0.9
    still = jax.tree.map(lambda x: jnp.repeat(x[:, None], 13, axis=1), start)
    assert jax.vmap(cart.success)(task, still).mean() < 0.5


def test_demonstrations_are_planned_by_the_programs_that_found_the_plans(cart, scenes, caplog):
    """From nothing, in rounds and from plans: of each large program one is compiled."""
    settings = dataclasses.replace(SETTINGS, rounds=1, scenes=4)
    task, start, keys = jax.tree.map(lambda x: x[:7], scenes)
    with jax.log_compiles():
        found = demonstrations.find_plans(cart, settings, NOISE, jax.random.key(0), 5)
        found = demonstrations.share_plans(cart, settings, found, NOISE, jax.random.key(0), 5)
        make = functools.partial(demonstrations.demonstrate, cart, settings, found, NOISE)
        map_in_chunks(make, (task, start, keys), 5)
    counts = [caplog.text.count(f"XLA compilation of jit({name})") for name in ("_begin_from", "_improve", "_execute")]
    assert counts == [1, 1, 1]


@pytest.mark.parametrize(("batch", "expected"), [(5, [5, 5]), (12, [12]), (13, [6])])
def test_no_more_than_half_of_a_batch_is_planned_in_vain(cart, monkeypatch, batch, expected):
    sizes = []

    def improve(env, settings, task, start, search, keys):
        sizes.append(len(keys))
        return search

    monkeypatch.setattr(demonstrations, "_improve", improve)
    monkeypatch.setattr(demonstrations, "_execute", lambda *args: (None, None))
    monkeypatch.setattr(demonstrations, "judge", lambda env, task, states: (jnp.zeros(len(task), bool), {}))
    settings = dataclasses.replace(SETTINGS, from_nothing=1)
    found = demonstrations.find_plans(cart, settings, NOISE, jax.random.key(0), batch)
    assert (sizes, len(found.success)) == (expected, 6)


@pytest.mark.slow
def test_scenes_begin_again_with_each_other_s_plans(cart, plans):
    """Compares rounds with searches in a loop that begin with plans that succeeded, although others are better."""
    kept = np.arange(6) >= 4
    given = plans._replace(knots=plans.knots.at[4:].add(0.05), success=jnp.asarray(kept))
    alone = Planner(cart, SETTINGS)
    for number in (0, 1):
        shared = demonstrations._shared(cart, SETTINGS, given, NOISE, jax.random.key(0), number, 4)
        for scene, key in enumerate(jax.random.split(jax.random.key(0), 6)):
            task_key, scene_key, _, key = jax.random.split(key, 4)
            task = cart.sample_task(task_key, "train")
            start = cart.reset(scene_key, task)
            begun = alone.begin_from(task, start, given)
            search = alone.improve(task, start, begun, jax.random.key(0), SETTINGS.search.iterations)
            executed = alone.execute(task, start, search, jax.random.fold_in(key, 1 + number), NOISE)[0]
            success = bool(cart.success(task, executed))
            assert bool(shared.success[scene]) == (success or kept[scene])
            expected = search.knots if success else given.knots[scene]
            np.testing.assert_allclose(shared.knots[scene], expected, atol=1e-4)
        assert shared.success.sum() > 4
        assert np.abs(shared.knots[4:] - given.knots[4:]).max() > 1e-3, "plans that succeeded are replaced, too"


@pytest.mark.parametrize(("rounds", "succeeded", "expected"), [(3, 1, [0, 1, 2]), (0, 3, []), (9, 0, [])])
def test_plans_are_shared_in_rounds_where_one_has_succeeded(cart, plans, monkeypatch, rounds, succeeded, expected):
    numbers = []

    def shared(env, settings, plans, noise, key, number, batch):
        numbers.append(number)
        return plans

    monkeypatch.setattr(demonstrations, "_shared", shared)
    given = plans._replace(success=jnp.arange(6) < succeeded)
    demonstrations.share_plans(cart, dataclasses.replace(SETTINGS, rounds=rounds), given, NOISE, jax.random.key(0), 4)
    assert numbers == expected


def test_what_is_executed_is_what_was_recorded_and_noise(cart, scenes, plans):
    demonstrate = functools.partial(demonstrations.demonstrate, cart, SETTINGS, plans)
    cart_laws.check_that_noise_alone_is_not_recorded(demonstrate, scenes, NOISE)


def test_a_plan_that_is_kept_is_tracked_in_the_world(cart, scenes):
    """No candidate is drawn, and nothing is planned again; a loop returns to the path of the approximation."""
    task, start = scenes[0][0], jax.tree.map(lambda x: x[0], scenes[1])
    kept = dataclasses.replace(SETTINGS, every=12)
    knots = np.array([[1.0], [-0.5], [0.8], [-2.5]])
    for tracking in (True, False):
        execute = jax.jit(
            lambda tracking=tracking: Planner(cart, kept).execute(
                task, start, sampling.start(knots, 0.0), jax.random.key(0), 0.0, tracking
            )
        )
        states, actions = execute()
        state = expected = start
        for t, u in enumerate(np.clip(np.interp(np.arange(12), np.linspace(0, 11, 4), knots[:, 0]), -2, 2)):
            back = 2 * float((expected.qpos - state.qpos)[0]) if tracking else 0.0
            action = np.clip((u + back) / 2, -1, 1)
            np.testing.assert_allclose(actions[t, 0], action, atol=1e-5)
            state = cart.step(task, state, jnp.array([action]))
            expected = cart.approximate_step(task, expected, jnp.array([u / 2]))
            np.testing.assert_allclose(states.qpos[t + 1], state.qpos, atol=1e-5)


def test_only_noise_tells_two_demonstrations_of_a_scene_apart(cart, scenes, plans):
    demonstrate = functools.partial(demonstrations.demonstrate, cart, SETTINGS, plans)
    cart_laws.check_that_noise_alone_tells_demonstrations_of_a_scene_apart(demonstrate, scenes, NOISE)


def test_what_is_sampled_is_what_its_version_says(cart, scenes, plans):
    few = jax.tree.map(lambda x: x[:3], scenes)
    _, whole = demonstrations.demonstrate(cart, SETTINGS, plans, NOISE, *few)
    ahead = receding.Settings(search=SETTINGS.search)
    _, next_steps = receding.demonstrate(cart, ahead, NOISE, *few)
    planned.check("cart", [VERSION], np.concatenate([whole.ravel(), next_steps.ravel()]), atol=1e-4)


def test_scenes_do_not_depend_on_those_beside_them(cart, scenes, plans):
    task, start, keys = scenes
    few = lambda tree: jax.tree.map(lambda x: x[:8], tree)  # noqa: E731
    states, actions = demonstrations.demonstrate(cart, SETTINGS, plans, NOISE, task, start, keys)
    alone, of_them = demonstrations.demonstrate(cart, SETTINGS, plans, NOISE, few(task), few(start), keys[:8])
    np.testing.assert_allclose(of_them, actions[:8], atol=1e-4)
    np.testing.assert_allclose(alone.qpos, states.qpos[:8], atol=1e-4)


def test_the_rest_is_planned_again_at_the_largest_divisor_of_the_horizon(cart, scenes, plans, monkeypatch):
    asked = []
    execute = planner.replanning.execute

    def note(problem, state, search, horizon, every, *rest):
        asked.append(every)
        return execute(problem, state, search, horizon, every, *rest)

    monkeypatch.setattr(planner, "replanning", types.SimpleNamespace(execute=note))
    start = jax.tree.map(lambda x: x[0], scenes[1])
    for every, expected in ((1, 1), (5, 4), (7, 6), (100, 12)):
        chosen = Planner(cart, dataclasses.replace(SETTINGS, every=every))
        jax.eval_shape(lambda chosen=chosen: chosen.execute(scenes[0][0], start, chosen.begin(), scenes[2][0], 0.0))
        assert asked.pop() == expected
