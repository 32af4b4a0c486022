"""Demonstration sets: to disk and back, which frames and demonstrations a batch draws, what it renders."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.core import pytrees
from milx.data import simulated as demos_lib
from milx.data.frames import frame_indices
from milx.trajopt.expert import Planned

MANY = 4


@pytest.fixture(scope="module")
def file(trained, tmp_path_factory):
    path = tmp_path_factory.mktemp("demos") / "sub" / "train.npz"
    pytrees.write(path, trained.train)
    return path


@pytest.fixture(scope="module")
def like(trained):
    return demos_lib.shapes(trained.run.env, 8, 3)


def assert_equal(found, expected):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for name, leaf in pytrees.leaves(expected).items():
        other = pytrees.leaves(found)[name]
        assert other.dtype == leaf.dtype, name
        np.testing.assert_array_equal(other, leaf, err_msg=name)


def test_saved_set_loads_equal(trained, file, like):
    loaded = pytrees.read(file, like)
    assert_equal(loaded, trained.train)
    assert (loaded.num_tasks, loaded.num_demos) == (8, 3)
    assert pytrees.fingerprint(loaded) == pytrees.fingerprint(trained.train)
    assert [path.name for path in file.parent.iterdir()] == ["train.npz"]


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("states.qvel", None, "states.qvel: missing, expected float32 (8, 3, 51, 2)"),
        ("action", lambda x: x[:, :, :-1], "action: got float32 (8, 3, 49, 2), expected float32 (8, 3, 50, 2)"),
        ("success", lambda x: x.astype(np.uint8), "success: got uint8 (8, 3), expected bool (8, 3)"),
        ("task.target", lambda x: x[:5], "task.target: got int32 (5,), expected int32 (8,)"),
    ],
)
def test_file_that_does_not_fit_is_refused(file, like, tmp_path, name, change, message):
    with np.load(file) as loaded:
        arrays = dict(loaded)
    array = arrays.pop(name)
    if change:
        arrays[name] = change(array)
    path = tmp_path / "other.npz"
    np.savez(path, **arrays)
    with pytest.raises(ValueError) as error:
        pytrees.read(path, like)
    assert str(error.value) == f"{path}: {message}"


class Payload:
    """What runs code when it is unpickled."""

    def __reduce__(self):
        return exec, ("raise __import__('os').error('executed')",)


def test_a_pickle_is_refused_and_not_executed(tmp_path):
    np.savez(tmp_path / "file.npz", a=np.array([Payload()], object))
    with pytest.raises(ValueError, match="allow_pickle=False"):
        pytrees.read(tmp_path / "file.npz", {"a": jnp.zeros(1)})


def test_fingerprint_sees_every_number(trained):
    original = pytrees.fingerprint(trained.train)
    leaves, structure = jax.tree.flatten(trained.train)
    seen = {original}
    for i, leaf in enumerate(leaves):
        array = np.array(leaf)
        last = array.reshape(-1)[-1]
        array[(-1,) * array.ndim] = (
            ~last
            if array.dtype == bool
            else np.nextafter(last, np.float32(9))
            if (array.dtype.kind == "f")
            else last + 1
        )
        seen.add(pytrees.fingerprint(jax.tree.unflatten(structure, [*leaves[:i], array, *leaves[i + 1 :]])))
    assert len(seen) == len(leaves) + 1
    assert pytrees.fingerprint(jax.tree.map(np.array, trained.train)) == original


def test_cache_gives_what_it_planned(trained, cache):
    run, config = trained.run, trained.config
    folder = cache / "milx" / "demos"
    arguments = (run.env, config.seed, "train", 8, 3, config.data)
    files = {path: path.stat().st_mtime_ns for path in folder.glob("reach-train-*.npz")}
    assert_equal(demos_lib.cached(folder, *arguments), trained.train)
    assert {path: path.stat().st_mtime_ns for path in folder.glob("reach-train-*.npz")} == files


def test_cache_notices_other_arguments(trained, tmp_path, monkeypatch):
    data, asked = trained.config.data, []

    def collect(env, key, split, num_tasks, num_demos, config, parts):
        asked.append((split, num_tasks, num_demos, config.noise, config.plan_iterations))
        return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), demos_lib.shapes(env, num_tasks, num_demos))

    monkeypatch.setattr(demos_lib, "collect", collect)
    get = functools.partial(demos_lib.cached, tmp_path, trained.run.env)
    requests = [
        (0, "train", 2, 2, data),
        (1, "train", 2, 2, data),
        (0, "test", 2, 2, data),
        (0, "train", 3, 2, data),
        (0, "train", 2, 3, data),
        (0, "train", 2, 2, dataclasses.replace(data, noise=0.5)),
        (0, "train", 2, 2, dataclasses.replace(data, plan_iterations=4)),
    ]
    for request in [*requests, *requests]:
        get(*request)
    assert len(asked) == len(requests), "each is planned once"
    get(0, "train", 2, 2, dataclasses.replace(data, plan_batch=7))
    assert len(asked) == len(requests), "the batch of the planner does not change the set"


@pytest.mark.slow
def test_planning_that_was_killed_goes_on_with_the_next_part(trained, tmp_path, monkeypatch, capsys):
    """Plans 24 demonstrations, 10 at once; the second part is damaged meanwhile."""
    perform, calls = Planned.perform, []

    def killed(*arguments):
        calls.append(arguments)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return perform(*arguments)

    monkeypatch.setattr(Planned, "perform", killed)
    arguments = (tmp_path, trained.run.env, trained.config.seed, "train", 8, 3, trained.config.data)
    with pytest.raises(KeyboardInterrupt):
        demos_lib.cached(*arguments)
    parts = sorted(tmp_path.glob("*.part-10-*.npz"))
    assert [path.name[-5:] for path in parts] == ["0.npz", "1.npz"]
    parts[1].write_bytes(parts[1].read_bytes()[:1000])
    assert_equal(demos_lib.cached(*arguments), trained.train)
    assert len(calls) == 3 + 2, "the second part again, and the third"
    said = capsys.readouterr().err
    assert f"milx: {parts[1]}: expected an .npz file" in said
    assert said.endswith("its contents are made again\n")
    assert len(list(tmp_path.iterdir())) == 1, "the parts are gone"


def test_demonstrations_that_diverge_are_dropped_and_counted(trained, monkeypatch, capsys):
    """Plans eight demonstrations, of which the third leaves the world and the fifth loses an action."""
    env, config = trained.run.env, dataclasses.replace(trained.config.data, plan_batch=8)

    def diverge(self, env, task, state, key, noise):
        states = jax.tree.map(lambda x: jnp.repeat(x[:, None], env.horizon + 1, axis=1), state)
        qpos = states.qpos.at[2, 30].set(jnp.inf)
        return dataclasses.replace(states, qpos=qpos), jnp.ones((8, env.horizon, 2)).at[4, 7, 1].set(jnp.nan)

    monkeypatch.setattr(Planned, "perform", diverge)
    monkeypatch.setattr(demos_lib, "judge", lambda env, task, states: (jnp.ones(8, bool), {}))
    demos = demos_lib.collect(env, jax.random.key(0), "train", 4, 2, config)
    assert "2 of 8 demonstrations diverged and are dropped" in capsys.readouterr().err
    assert demos.success.tolist() == [[True, True], [True, False], [True, False], [True, True]]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(demos) if leaf.dtype != bool)
    np.testing.assert_array_equal(demos.action[~demos.success], 0)


def test_sets_of_the_splits_share_no_color(trained):
    colors = [
        np.asarray(getattr(trained, split).task.object_color).reshape(-1, 3)
        for split in ("train", "validation", "test")
    ]
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert np.abs(colors[i][:, None] - colors[j]).max(axis=-1).min() > 0.02


def test_demonstrations_of_a_task_have_scenes_of_their_own(trained):
    scenes = np.asarray(trained.train.states.mocap_pos[:, :, 0]).reshape(24, -1)
    assert (np.abs(scenes[:, None] - scenes).max(axis=-1) + np.eye(24)).min() > 0.01


@pytest.mark.parametrize(("length", "count"), [(50, 6), (50, 2), (50, 1), (50, 49), (10, 3), (7, 6), (3, 2)])
def test_frames_come_one_from_each_part_and_the_last_always(length, count):
    keys = jax.random.split(jax.random.key(0), 2000)
    index = np.asarray(jax.vmap(lambda key: frame_indices(key, length, count))(keys))
    assert index.shape == (2000, count)
    assert (np.diff(index, axis=1) > 0).all()
    assert (index[:, -1] == length - 1).all()
    # Parts are equal up to the rounding of their ends.
    edges = np.arange(count) * (length - 1) / max(count - 1, 1)
    assert (index[:, :-1] > edges[:-1] - 1).all()
    assert (index[:, :-1] < edges[1:]).all()
    drawn = np.arange(length) if count > 1 else [length - 1]
    np.testing.assert_array_equal(np.unique(index), drawn, "every step is drawn sometimes")


@pytest.mark.parametrize(("length", "count", "exponent"), [(50, 4, 2.0), (100, 8, 2.0), (50, 10, 3.0), (9, 8, 2.0)])
def test_a_larger_exponent_draws_more_of_the_beginning(length, count, exponent):
    keys = jax.random.split(jax.random.key(1), 20_000)
    index = np.asarray(jax.vmap(lambda key: frame_indices(key, length, count, exponent))(keys))
    assert (np.diff(index, axis=1) > 0).all()
    assert (index[:, -1] == length - 1).all()
    # Each part is drawn from evenly, so its mean is that of its ends, which are T - 1 times (i / (n - 1))^e.
    edges = np.floor((length - 1) * (np.arange(count) / (count - 1)) ** exponent + 1e-9)
    for i in range(1, count):
        edges[i] = max(edges[i], edges[i - 1] + 1)
    middle = (edges[:-1] + edges[1:] - 1) / 2
    deviation = np.diff(edges) / np.sqrt(12 * len(keys))
    np.testing.assert_array_less(np.abs(index[:, :-1].mean(axis=0) - middle), 5 * deviation)


@pytest.mark.parametrize("count", [None, 5, 8])
def test_all_frames(count):
    np.testing.assert_array_equal(frame_indices(jax.random.key(0), 5, count), np.arange(5))


def test_rendered_states_are_the_robot_s(trained):
    env, demos = trained.run.env, trained.train
    task, states, action = jax.tree.map(lambda x: x[3], (demos.task, demos.states, demos.action))
    states, action = jax.tree.map(lambda x: x[1], (states, action))
    index = jnp.array([0, 7, 30, 49])
    few = jax.jit(demos_lib.render_demo, static_argnums=0)(env, task, states, action, index)
    every = jax.jit(jax.vmap(env.robot_state))(states)
    assert every.shape == (51, 8)
    np.testing.assert_allclose(few.state, every[index], atol=1e-6)
    np.testing.assert_array_equal(few.action, action[index])
    assert np.abs(np.diff(few.state, axis=0)).max(axis=1).min() > 1e-3
    assert (np.abs(np.diff(few.image.astype(int), axis=0)).max(axis=-1) > 40).sum(axis=(1, 2)).min() > 0


@pytest.fixture(scope="module")
def draw(trained):
    """Samples one-shot batches of MANY tasks with every state; images are left out, which spares their rendering."""

    def batch(key):
        drawn = demos_lib.sample_batch(trained.run.env, trained.train, jax.random.split(key, MANY), shots=1)
        return dataclasses.replace(
            drawn,
            support=dataclasses.replace(drawn.support, image=None),
            query=dataclasses.replace(drawn.query, image=None),
        )

    return jax.jit(batch)


def find(trained, demo):
    """Finds task and demonstration in the training set with the actions [T, A], which no two share."""
    gap = np.abs(np.asarray(trained.train.action) - np.asarray(demo.action)).max(axis=(-2, -1))
    assert (gap == 0).sum() == 1
    return np.unravel_index(gap.argmin(), gap.shape)


def test_support_and_query_are_different_demonstrations_of_one_task(trained, draw):
    every = np.asarray(jax.jit(jax.vmap(jax.vmap(jax.vmap(trained.run.env.robot_state))))(trained.train.states))
    tasks, pairs = set(), set()
    for seed in range(8):
        batch = draw(jax.random.key(seed))
        assert batch.support.action.shape == (MANY, 1, 50, 2)
        for n in range(MANY):
            support, query = (jax.tree.map(lambda x, n=n: x[n, 0], d) for d in (batch.support, batch.query))
            (task, shown), (other, asked) = find(trained, support), find(trained, query)
            assert task == other
            assert shown != asked
            np.testing.assert_allclose(support.state, every[task, shown, :-1], atol=1e-6)
            np.testing.assert_allclose(query.state, every[task, asked, :-1], atol=1e-6)
            tasks.add(int(task))
            pairs.add((int(shown), int(asked)))
    # 32 draws miss one of 8 tasks with probability 0.11, two with 0.003.
    assert len(tasks) >= 7
    assert len(pairs) == 6


def test_time_steps_hold_the_actions_of_those_that_follow(trained):
    """Lets the last action stand for those after the end."""
    env, keys = trained.run.env, jax.random.split(jax.random.key(9), 2)
    plain, chunked = (
        jax.jit(lambda keys, c=c: demos_lib.sample_batch(env, trained.train, keys, 1, chunk=c).query.action)(keys)
        for c in (1, 3)
    )
    later = [np.concatenate([plain[:, :, k:], np.repeat(plain[:, :, -1:], k, axis=2)], axis=2) for k in range(3)]
    np.testing.assert_array_equal(chunked, np.concatenate(later, axis=-1))


def test_only_successful_demonstrations_are_drawn(trained):
    """Lets one demonstration of the first task fail and two of the second, whose third has no partner."""
    success = jnp.ones((8, 3), bool).at[0, 1].set(False).at[1, 1:].set(False)
    demos, env = dataclasses.replace(trained.train, success=success), trained.run.env
    batch = jax.jit(lambda keys: demos_lib.sample_batch(env, demos, keys, 1, 1, 1))(
        jax.random.split(jax.random.key(7), 100)
    )
    last = np.asarray(jax.jit(jax.vmap(jax.vmap(env.robot_state)))(jax.tree.map(lambda x: x[:, :, -2], demos.states)))
    for shown in (batch.support, batch.query):
        gap = np.abs(shown.state[:, 0, 0, None, None] - last).max(axis=-1)
        drawn = (gap.reshape(100, 24) < 1e-6).sum(axis=0).reshape(8, 3)
        assert drawn.sum() == 100
        assert not drawn[~np.asarray(success)].any()
        assert not drawn[1].any()
        assert drawn[0, [0, 2]].min() > 0
        assert drawn[2:].min() > 0


@pytest.mark.slow
def test_a_redrawn_batch_shows_the_same_demonstrations_in_new_colors_and_places(trained):
    env, keys = trained.run.env, jax.random.split(jax.random.key(6), 3)
    batches = [
        jax.jit(lambda keys, redraw=redraw: demos_lib.sample_batch(env, trained.train, keys, 1, 2, 2, redraw))(keys)
        for redraw in (False, True)
    ]
    plain, redrawn = batches
    for a, b in ((plain.support, redrawn.support), (plain.query, redrawn.query)):
        np.testing.assert_array_equal(a.state, b.state)
        np.testing.assert_array_equal(a.action, b.action)
        changed = np.abs(a.image.astype(int) - b.image.astype(int)).max(axis=-1) > 2
        # Three cubes of 0.06 m in an arena of 0.6 m cover 3% of it, in the old places and the new ones.
        assert 0.005 < changed.mean() < 0.1
    # Support and query of a task show the same three new colors: the brightest red of the cubes agrees.
    seen = [np.asarray(d.image, int) for d in (redrawn.support, redrawn.query)]
    other = [np.asarray(d.image, int) for d in (plain.support, plain.query)]
    for n in range(3):
        ground = np.median(seen[0][n], axis=(0, 1, 2))
        apart = [np.minimum(np.abs(s[n] - o[n]), np.abs(s[n] - ground)) for s, o in zip(seen, other, strict=True)]
        new = [s[n][gap.max(axis=-1) > 20] for s, gap in zip(seen, apart, strict=True)]
        np.testing.assert_allclose(new[0].max(axis=0), new[1].max(axis=0), atol=25)


def test_batch_is_a_function_of_the_key(draw):
    first, again, other = draw(jax.random.key(3)), draw(jax.random.key(3)), draw(jax.random.key(4))
    jax.tree.map(np.testing.assert_array_equal, first, again)
    assert np.abs(first.query.action - other.query.action).max() > 1e-3
