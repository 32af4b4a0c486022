"""What reach draws: colors of the splits, scenes and their distances, and where the camera sees them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import ks_2samp

import milx
from milx.envs.base import State
from milx.envs.reach import env as reach

EPISODES = 4
IMAGE_SHAPE = (48, 60)


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def env():
    return milx.make("reach", IMAGE_SHAPE)


@pytest.fixture(scope="module")
def task(env):
    return env.sample_task(jax.random.key(0), "train")


@pytest.fixture(scope="module")
def tasks(env):
    """Samples 4,000 tasks of every split."""
    keys = jax.random.split(jax.random.key(2), 4000)
    return {
        split: jax.jit(jax.vmap(lambda key, split=split: env.sample_task(key, split)))(keys)
        for split in ("train", "validation", "test")
    }


def assert_uniform(counts):
    """Counts of equally likely outcomes lie within four standard deviations of their mean."""
    counts = np.asarray(counts)
    n, p = counts.sum(), 1 / counts.size
    np.testing.assert_allclose(counts, n * p, atol=4 * np.sqrt(n * p * (1 - p)))


def test_splits_draw_colors_from_disjoint_grids(tasks):
    seen = {}
    for split, offset in {"train": 0, "validation": 25, "test": 50}.items():
        color = np.asarray(tasks[split].object_color)
        thousandths = np.rint(1000 * color).astype(int)
        np.testing.assert_allclose(1000 * color, thousandths, atol=1e-3)
        assert set(thousandths.ravel()) == set(range(offset, offset + 1000, 100))
        for cube in range(3):
            for channel in range(3):
                assert_uniform(np.unique(thousandths[:, cube, channel], return_counts=True)[1])
        seen[split] = {tuple(rgb) for rgb in thousandths.reshape(-1, 3)}
        assert len(seen[split]) > 990, "12,000 draws of 1,000 colors"
    assert not seen["train"] & seen["test"]
    assert not seen["train"] & seen["validation"]
    assert not seen["validation"] & seen["test"]


def test_a_task_has_three_colors_and_any_cube_as_target(tasks):
    for drawn in tasks.values():
        color = np.asarray(drawn.object_color)
        gap = np.abs(color[:, [0, 0, 1]] - color[:, [1, 2, 2]]).max(axis=-1)
        assert gap.min() > 0.099
        assert_uniform(np.bincount(drawn.target, minlength=3))


def test_a_redrawn_task_keeps_its_target_and_has_other_training_colors(env, tasks):
    keys = jax.random.split(jax.random.key(5), 4000)
    redrawn = jax.jit(jax.vmap(env.redraw_appearance))(keys, tasks["train"])
    np.testing.assert_array_equal(redrawn.target, tasks["train"].target)
    colors = np.asarray(redrawn.object_color)
    np.testing.assert_allclose(colors, np.round(colors, 1), atol=1e-6)  # the training grid is that of whole tenths
    assert_uniform(np.bincount(np.round(colors * 10).astype(int).ravel(), minlength=10))
    assert np.abs(colors[:, [0, 0, 1]] - colors[:, [1, 2, 2]]).max(axis=-1).min() > 0.09
    # A cube keeps its color with probability 1/1000.
    kept = (np.abs(colors - tasks["train"].object_color).max(axis=-1) < 1e-6).sum()
    assert kept < 12 + 4 * np.sqrt(12)


def test_a_redrawn_scene_moves_only_the_distractors_to_where_reset_would_put_them(env, tasks):
    task, target = tasks["train"], np.asarray(tasks["train"].target)
    draws, keys = len(target), jax.random.split(jax.random.key(7), 3)
    one = jax.jit(jax.vmap(env.reset))(jax.random.split(keys[0], draws), task)
    episodes = jax.tree.map(lambda x: np.repeat(np.asarray(x)[:, None], 3, axis=1), one)
    redrawn = jax.jit(jax.vmap(env.redraw_scene))(jax.random.split(keys[1], draws), task, episodes)
    np.testing.assert_array_equal(redrawn.vector, episodes.vector)
    position, before = np.asarray(redrawn.mocap_pos), np.asarray(episodes.mocap_pos)
    np.testing.assert_array_equal(position[:, 1:], position[:, :-1])  # nothing moves during the episode
    rows = np.arange(draws)
    np.testing.assert_array_equal(position[rows, 0, target], before[rows, 0, target])
    assert np.mean(np.any(position != before, axis=-1)) > 0.66, "two of three stand elsewhere"
    fresh = np.asarray(jax.jit(jax.vmap(env.reset))(jax.random.split(keys[2], draws), task).mocap_pos)

    def gaps(position):
        return np.linalg.norm(position[:, [0, 0, 1], :2] - position[:, [1, 2, 2], :2], axis=-1)

    assert gaps(position[:, 0]).min() >= 0.15
    assert ks_2samp(gaps(position[:, 0])[:, 0], gaps(fresh)[:, 0]).pvalue > 1e-4
    for cube in range(3):
        assert_uniform(np.bincount((position[:, 0, cube, :2] > 0) @ [1, 2], minlength=4))


def test_calibration_tells_where_in_the_image_a_cube_stands(env):
    """Finds the cube's pixels by drawing it in another color; their center is where the calibration puts it."""
    spots = np.random.default_rng(0).uniform(-0.19, 0.19, (6, 2))
    image_to_goal = env.image_to_goal
    for spot in spots:
        position = np.array([[*spot, 0.03], [0.5, 0.5, 0.03], [0.5, -0.5, 0.03]])
        state = State(jnp.array([np.pi, 0.0]), jnp.zeros(2), jnp.asarray(position))
        task = [reach.ReachTask(jnp.full((3, 3), level).at[1:].set(0.5), jnp.asarray(0)) for level in (0.1, 0.9)]
        dark, light = (np.asarray(env.observe(t, state).image, int) for t in task)
        rows, cols = np.nonzero(np.abs(light - dark).max(axis=-1) > 60)
        height, width = env.image_shape
        center = np.array([(2 * cols.mean() + 1) / width - 1, (2 * rows.mean() + 1) / height - 1, 1.0])
        # Half a pixel is 4 mm; a cube of 6 cm, seen from 1.2 m, shows a little of its sides.
        np.testing.assert_allclose(center @ image_to_goal, spot, atol=0.008)


def test_scenes_keep_their_distances_and_the_arm_starts_at_zero(env, task):
    draws = 20_000
    scenes = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(jax.random.split(jax.random.key(3), draws), task)
    np.testing.assert_array_equal(scenes.qpos, 0)
    np.testing.assert_array_equal(scenes.qvel, 0)
    position = np.asarray(scenes.mocap_pos)
    assert np.abs(position[..., :2]).max() <= 0.2
    np.testing.assert_allclose(position[..., 2], 0.03, rtol=1e-6)
    gaps = np.linalg.norm(position[:, [0, 0, 1], :2] - position[:, [1, 2, 2], :2], axis=-1)
    assert 0.15 <= gaps.min() < 0.151
    # Every cube may stand in every quadrant.
    for cube in range(3):
        assert_uniform(np.bincount((position[:, cube, :2] > 0) @ [1, 2], minlength=4))


def test_scenes_are_uniform_under_the_distance_rule(env, task):
    """Compares the mean distance between two cubes with that of rejection sampling in NumPy."""
    positions = np.random.default_rng(0).uniform(-0.2, 0.2, (100_000, 3, 2))
    gaps = np.linalg.norm(positions[:, [0, 0, 1]] - positions[:, [1, 2, 2]], axis=-1)
    expected = gaps[gaps.min(axis=-1) >= 0.15]
    scenes = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(jax.random.split(jax.random.key(4), 20_000), task)
    position = np.asarray(scenes.mocap_pos)[..., :2]
    gaps = np.linalg.norm(position[:, [0, 0, 1]] - position[:, [1, 2, 2]], axis=-1)
    error = expected.std() / np.sqrt(len(gaps)) + expected.std() / np.sqrt(len(expected))
    np.testing.assert_allclose(gaps.mean(axis=0), expected.mean(), atol=4 * error)


def test_task_blind_goes_to_every_cube_equally_often(env, task):
    keys = jax.random.split(jax.random.key(5), 6000)
    for target in range(3):
        blind = jax.vmap(env.task_blind, in_axes=(0, None))(keys, dataclasses.replace(task, target=jnp.array(target)))
        assert_uniform(np.bincount(blind.target, minlength=3))
        np.testing.assert_array_equal(blind.object_color, np.broadcast_to(task.object_color, (6000, 3, 3)))


# Success.
