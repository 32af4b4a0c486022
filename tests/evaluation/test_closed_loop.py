"""Wilson's interval, which scenes are tried, and that the size of a batch changes nothing."""

import dataclasses
import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from tiny import tiny_config

from milx.config.schema import EvalConfig
from milx.core import parallel
from milx.core.batching import map_in_chunks, map_in_groups
from milx.envs.reach.env import Reach
from milx.evaluation import closed_loop, intervals
from milx.methods import Method
from milx.methods.chunks import Chunked
from milx.methods.whitening import Whitening
from milx.training import simulated
from milx.trajopt.expert import Planned

# Wilson's interval of k successes in n trials, to four digits; by hand, 0/n ends at z^2 / (n + z^2).
KNOWN = {
    (0, 10): (0.0, 0.2775),
    (9, 10): (0.5958, 0.9821),
    (10, 10): (0.7225, 1.0),
    (5, 10): (0.2366, 0.7634),
}


@pytest.mark.parametrize(("successes", "trials"), KNOWN)
def test_wilson_interval_against_known_values(successes, trials):
    np.testing.assert_allclose(intervals.wilson_interval(successes, trials), KNOWN[successes, trials], atol=5e-5)


@pytest.mark.parametrize("trials", [1, 4, 7, 10, 50, 150, 200, 600, 1500])
def test_wilson_interval_against_scipy(trials):
    for successes in {0, 1, trials // 3, trials - 1, trials}:
        expected = scipy.stats.binomtest(successes, trials).proportion_ci(method="wilson")
        low, high = intervals.wilson_interval(successes, trials)
        np.testing.assert_allclose((low, high), (expected.low, expected.high), atol=1e-7)
        assert 0 <= low <= successes / trials <= high <= 1


def test_a_result_counts_trials_by_every_criterion_and_has_baselines_beside_each():
    table = jnp.array([[True, False, True], [False, False, True]])
    baselines = closed_loop.Baselines({"random": 0.1}, {"nearly": {"random": 0.2}})
    env = types.SimpleNamespace(vision=True, criterion="exactly", version=3, target_kind=lambda task: task)
    trials = closed_loop.Trials(table, {"nearly": ~table | table}, ())
    misled = closed_loop.Trials(~table, {"nearly": table}, ())
    found = closed_loop.summarize(env, tiny_config(), jnp.array([-1, -1]), trials, misled, baselines)
    assert (found["trials"], found["success"], found["env_version"]) == (6, 0.5, 3)
    assert found["baselines"] == {"random": 0.1, "other_demo": 0.5}
    assert found["wilson95"] == list(intervals.wilson_interval(3, 6))
    np.testing.assert_allclose(found["bootstrap95"], [1 / 3, 2 / 3], rtol=1e-6)
    other = found["other_criteria"]["nearly"]
    assert (other["success"], other["bootstrap95"]) == (1.0, [1.0, 1.0])
    assert other["wilson95"] == list(intervals.wilson_interval(6, 6))
    assert other["baselines"] == {"random": 0.2, "other_demo": 0.5}


def test_bootstrap_interval_is_over_things_and_not_over_trials():
    """Compares with the binomial's percentiles for as many objects, where trials of one object agree."""
    kind = np.random.default_rng(1).permutation(np.repeat(np.arange(16), 10))
    success = np.repeat((kind < 8)[:, None], 6, axis=1)
    expected = scipy.stats.binom(16, 0.5).ppf([0.025, 0.975]) / 16
    np.testing.assert_allclose(intervals.bootstrap_interval(success, kind), expected, atol=1e-9)
    low, high = intervals.wilson_interval(int(success.sum()), success.size)
    assert high - low < 0.25 * (expected[1] - expected[0])


@dataclasses.dataclass(frozen=True, eq=False)
class Replay(Method):
    """Repeats the first demonstration's actions, whatever it sees: the memory counts the steps."""

    def init(self, key, whitening):
        return ()

    def loss(self, params, batch, progress=1.0):
        raise NotImplementedError

    def adapt(self, params, demo):
        return demo.action[0]

    def act(self, task_params, observation, memory):
        return task_params[memory], memory + 1

    def initial_memory(self, key):
        return jnp.zeros((), jnp.int32)


@pytest.mark.slow
def test_table_is_the_same_for_batches_of_two_and_three_and_for_tasks_adapted_one_by_one(trained, monkeypatch):
    env, key, config = trained.run.env, jax.random.key(5), EvalConfig(trials=24, shots=1, batch=3)

    def succeed(batch):
        chosen = dataclasses.replace(config, batch=batch)
        return closed_loop.run_trials(env, Replay(), (), trained.test, chosen, key).success

    three, two = succeed(3), succeed(2)
    monkeypatch.setattr(closed_loop, "_PIXELS", 1)
    one_by_one = succeed(3)
    assert three.shape == (3, 24)
    assert 0 < three.mean() < 1, "replay succeeds by luck in some scenes"
    np.testing.assert_array_equal(two, three)
    np.testing.assert_array_equal(one_by_one, three)


@pytest.mark.slow
def test_a_demonstration_that_is_repeated_in_chunks_ends_like_one_that_is_repeated_action_by_action(trained):
    env, key, config = trained.run.env, jax.random.key(5), EvalConfig(trials=4, shots=1, batch=3)
    plain, chunked = (
        closed_loop.run_trials(env, method, (), trained.test, config, key).states
        for method in (Replay(), Chunked(Replay(), 4, 4, env.action_size))
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), plain, chunked)


@pytest.mark.parametrize(("shots", "pixels", "at_once"), [(2, 8000 * 3, 3), (2, 8000 * 3 - 1, 2), (1, 8000 * 3, 6)])
def test_so_many_tasks_are_adapted_at_once_as_share_the_pixels(shots, pixels, at_once, monkeypatch):
    monkeypatch.setattr(closed_loop, "_PIXELS", pixels)
    action = np.zeros((7, shots, 50, 2))
    assert closed_loop._tasks_at_once(types.SimpleNamespace(vision=True, image_shape=(8, 10)), action) == at_once
    assert closed_loop._tasks_at_once(types.SimpleNamespace(vision=False, image_shape=(8, 10)), action) == 7


@pytest.mark.parametrize("split", ["validation", "test"])
def test_no_trial_takes_place_in_the_demonstration_s_scene(trained, split, monkeypatch):
    demos = getattr(trained, split)
    # What a trial is given: its scene, and the demonstration that the policy adapts to.
    monkeypatch.setattr(closed_loop, "_adaptation", lambda *_: lambda params, task, states, action: (states, action))
    monkeypatch.setattr(closed_loop, "_acting", lambda *_: lambda seen, task, scene, key: (scene, *seen))
    config = dataclasses.replace(trained.config.evaluation, trials=10)
    key = simulated.trial_key(split)
    scene, states, action = closed_loop.run_trials(trained.run.env, trained.run.method, (), demos, config, key)
    np.testing.assert_array_equal(action, demos.action[:, :1])
    cubes, shown = np.asarray(scene.mocap_pos), np.asarray(states.mocap_pos[:, :, 0])
    assert cubes.shape == (3, 10, 3, 3)
    apart = np.abs(cubes[:, :, None] - shown[:, None]).max(axis=(-2, -1))
    assert apart.min() > 0.01, "some cube stands at least 1 cm elsewhere"
    flat = cubes.reshape(30, -1)
    between = np.abs(flat[:, None] - flat).max(axis=-1) + np.eye(30)
    assert between.min() > 0.01, "no two trials share a scene"
    np.testing.assert_array_equal(scene.qpos, 0)
    some, *_ = closed_loop.run_trials(trained.run.env, trained.run.method, (), demos, config, key, first=4)
    jax.tree.map(np.testing.assert_array_equal, some, jax.tree.map(lambda x: x[:, :4], scene))


@pytest.mark.slow
@pytest.mark.parametrize(("trials", "asked", "tried"), [(3, 1, 1), (2, 2, 2), (2, 10, 2)])
def test_baselines_run_in_the_first_trials(trained, monkeypatch, trials, asked, tried):
    env, key = trained.run.env, simulated.trial_key("test")
    config = dataclasses.replace(trained.config.evaluation, trials=trials, baseline_trials=asked)
    asked_for = {}

    def watch(self, env, task, scene, keys, noise):
        asked_for.update(task=task, scene=scene)
        assert noise == 0.0
        return jax.tree.map(lambda x: jnp.repeat(x[:, None], env.horizon + 1, axis=1), scene), None

    monkeypatch.setattr(Planned, "perform", watch)
    plans = dataclasses.replace(trained.config.data, plan_batch=2 * 3 * tried)
    rates = closed_loop.evaluate_baselines(env, trained.test, config, plans, key).success
    scene = closed_loop.trial_scenes(env, trained.test.task, jax.random.split(key)[0], trials)
    expected = jax.tree.map(lambda x: x[:, :tried].reshape(-1, *x.shape[2:]), scene)
    twice = jax.tree.map(lambda x: jnp.concatenate([x, x]), expected)
    jax.tree.map(np.testing.assert_array_equal, asked_for["scene"], twice)
    targets = np.asarray(asked_for["task"].target).reshape(2, 3, tried)
    np.testing.assert_array_equal(targets[1], np.repeat(trained.test.task.target[:, None], tried, axis=1))
    # Nobody moves, so both experts fare as the arm at rest does, judged by the true target.
    resting = jax.tree.map(lambda x: jnp.repeat(x[:, None], env.horizon + 1, axis=1), expected)
    task = jax.tree.map(lambda x: jnp.repeat(x, tried, axis=0), trained.test.task)
    rate = float(jax.vmap(env.success)(task, resting).mean())
    assert rates["expert"] == rates["task_blind"] == pytest.approx(rate)


def compiled(caplog, *names):
    """Tells which of these functions have been compiled since it was last called."""
    found = [f"XLA compilation of jit({name})" in caplog.text for name in names]
    caplog.clear()
    return found


@pytest.mark.slow
def test_programs_compiled_ahead_are_found(trained, caplog):
    method, config = Replay(), dataclasses.replace(trained.config.evaluation, trials=4)
    names, run = ("adapt_tasks", "run_tasks"), functools.partial(closed_loop.run_trials, trained.run.env, method, ())
    with jax.log_compiles():
        closed_loop.precompile(trained.run.env, method, (), config, (4, 1))
        assert compiled(caplog, *names) == [True, True]
        run(trained.test, config, jax.random.key(0))
        run(trained.test, config, jax.random.key(0), first=1)
        assert compiled(caplog, *names) == [False, False]


@pytest.mark.slow
def test_listening_and_filming_find_their_programs_compiled(trained, caplog):
    """A method and an environment of its own: nothing of them is compiled yet."""
    method, env, config = dataclasses.replace(trained.run.method), Reach((8, 10)), trained.config.evaluation
    whitening = Whitening(*(jnp.full(n, v) for n in (8, 2) for v in (0.0, 1.0)))
    params = method.init(jax.random.key(0), whitening)
    first = jax.tree.map(lambda x: x[:, 0], trained.validation.states)
    names = ("adapt_tasks", "_compare", "film")
    with jax.log_compiles():
        closed_loop.precompile(trained.run.env, method, params, config, ())
        closed_loop.precompile_listen(trained.run.env, method, params, config)
        closed_loop.precompile_film(env, 3)
        assert compiled(caplog, *names) == [True, True, True]
        closed_loop.listen(trained.run.env, method, params, trained.validation, config)
        closed_loop.film(env, *parallel.replicate((trained.validation.task, first)))
        assert compiled(caplog, *names) == [False, False, False]


def test_a_run_compiles_every_large_program_once(trained):
    """Trials are of the policy or of random actions; baselines and another task's demonstration need fewer."""
    once = {"run": 1, "_perform_planned": 1, "_compare": 1, "film": 1, "adapt_tasks": 2, "run_tasks": 3}
    assert {name: trained.compiled.count(name) for name in once} == once


def test_validation_and_test_trials_differ(trained):
    scenes = [
        closed_loop.trial_scenes(trained.run.env, trained.test.task, simulated.trial_key(split), 4).mocap_pos
        for split in ("validation", "test")
    ]
    assert np.abs(scenes[0] - scenes[1]).max(axis=(-2, -1)).min() > 0.01


@pytest.mark.parametrize(("total", "size"), [(7, 3), (7, 7), (7, 10), (6, 3), (1, 4), (7, 1)])
def test_map_in_chunks_is_a_plain_call(total, size):
    rng = np.random.default_rng(0)
    inputs = ({"a": jnp.asarray(rng.standard_normal((total, 2)))}, jnp.arange(total))
    shapes = []

    def function(tree, index):
        shapes.append(index.shape)
        return {"sum": tree["a"].sum(axis=1) + index}, tree["a"] * index[:, None]

    found = map_in_chunks(function, inputs, size)
    assert shapes == [(size,)] * -(-total // size), "every call has the same size"
    jax.tree.map(np.testing.assert_array_equal, found, function(*inputs))

    rows = np.arange(total)[::-2]
    found = map_in_chunks(function, inputs, size, rows=rows)
    jax.tree.map(np.testing.assert_array_equal, found, function(*jax.tree.map(lambda x: x[rows], inputs)))


@pytest.mark.parametrize(("total", "most", "groups"), [(6, 4, 2), (6, 6, 1), (6, 9, 1), (7, 4, 7), (4, 0, 4)])
def test_map_in_groups_is_vmap_in_the_fewest_equal_groups(total, most, groups):
    def function(key, x, empty):
        return jax.random.randint(key, (2,), 0, 1000) + x, empty

    # Some parameters have no entries.
    inputs = jax.random.split(jax.random.key(0), total), jnp.arange(total), jnp.zeros((total, 0))
    by_groups = jax.jit(lambda *inputs: map_in_groups(function, inputs, most))
    for found, expected in zip(by_groups(*inputs), jax.vmap(function)(*inputs), strict=True):
        np.testing.assert_array_equal(found, expected)
    program = str(jax.make_jaxpr(by_groups)(*inputs))
    assert (f"length={groups}" in program) if groups > 1 else ("scan" not in program)


def test_map_in_chunks_takes_keys():
    keys = jax.random.split(jax.random.key(0), 5)
    draw = jax.vmap(jax.random.uniform)
    np.testing.assert_array_equal(map_in_chunks(draw, (keys,), 2), draw(keys))
