"""Demonstrations in a mirror, one by one and in batches for training."""

import dataclasses

import jax
import numpy as np
import pytest

from milx.data import simulated as demos_lib
from milx.data.augment import mirrored
from milx.data.goals import with_goals
from milx.types import Demo, TaskBatch

IMAGES = np.random.default_rng(0).integers(0, 200, (3, 8, 9, 3), np.uint8)


def test_a_mirror_swaps_left_and_right_and_twice_it_changes_nothing():
    rng = np.random.default_rng(1)
    demo = Demo(IMAGES, rng.normal(size=(3, 4)), rng.normal(size=(3, 2)), rng.normal(size=(3, 2)))
    mirror = (1, -1, -1, 1), (-1, 1)
    found = mirrored(demo, mirror, (0, 2))
    for column in range(IMAGES.shape[2]):
        np.testing.assert_array_equal(found.image[:, :, column], IMAGES[:, :, -1 - column])
    np.testing.assert_array_equal(
        found.state, np.stack([-x if i in (1, 2) else x for i, x in enumerate(demo.state.T)], 1)
    )
    np.testing.assert_array_equal(found.action, np.stack([-demo.action[:, 0], demo.action[:, 1]], 1))
    np.testing.assert_array_equal(found.goal, np.stack([demo.goal[:, 0], -demo.goal[:, 1]], 1))
    jax.tree.map(np.testing.assert_array_equal, mirrored(found, mirror, (0, 2)), demo)
    pairs = mirrored(Demo(None, demo.state, np.tile(demo.action, 2), demo.goal), mirror, (0, 2))
    np.testing.assert_array_equal(pairs.action, np.tile(found.action, 2))
    blind = mirrored(Demo(None, demo.state, demo.action, demo.goal), mirror, (0, 2))
    assert blind.image is None


@pytest.mark.parametrize("rule", [{}, {"height": 3}, {"step": 3}])
def test_mirrored_goals_are_those_of_the_mirrored_states(rule):
    """Expects the same goals if a random walk is mirrored before its goals are told or after."""
    state = np.random.default_rng(2).normal(size=(9, 4)).cumsum(0)
    mirror = (1, -1, -1, 1), (-1, 1)
    plain = Demo(state=state, action=state[:, :2])
    told = mirrored(with_goals(plain, (0, 2), **rule), mirror, (0, 2)).goal
    unknown = np.isnan(told).any(axis=1)
    assert not unknown[0] and unknown[-1] == bool(rule)
    before = dataclasses.replace(plain, state=state * np.array(mirror[0]))
    np.testing.assert_allclose(told, with_goals(before, (0, 2), **rule).goal, atol=1e-6)


@pytest.mark.slow
def test_half_of_the_tasks_of_a_redrawn_batch_are_seen_in_a_mirror(trained, monkeypatch):
    """Expects a task's support and query to be both as they are or both mirrored, with all that belongs to them."""
    env, keys = trained.run.env, jax.random.split(jax.random.key(7), 12)
    signs = tuple(np.where(np.arange(env.state_size) % 2, -1, 1).tolist()), (-1, 1)
    batches = []
    for mirror in (None, signs):
        monkeypatch.setattr(env, "mirror", mirror)
        draw = jax.jit(lambda keys: demos_lib.sample_batch(env, trained.train, keys, 1, 1, 1, redraw=True))
        batches.append(jax.device_get(draw(keys)))
    plain, found = batches
    turned = TaskBatch(*(mirrored(demo, signs, env.goal_indices) for demo in (plain.support, plain.query)), plain.task)

    def same(n, expected):
        leaves = (jax.tree.leaves(batch) for batch in (found, expected))
        return all(np.array_equal(x[n], y[n], equal_nan=True) for x, y in zip(*leaves, strict=True))

    kinds = [same(n, turned) for n in range(len(keys))]
    assert kinds == [not same(n, plain) for n in range(len(keys))]
    assert 0 < sum(kinds) < len(keys), "one kind alone at 1 in 2,000 by chance"
