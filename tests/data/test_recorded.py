"""Recorded demonstrations on the device: what batches hold, and shards that pass over data larger than their room."""

import jax
import numpy as np
import pytest

from milx.data import recorded as recorded_lib
from milx.data.dataset import DataSet, Writer, spread
from milx.data.recorded import Shards, read_demos, sample_batch
from milx.types import Demo

HORIZON = 6
DEMOS = [3, 2, 1, 4]
"""Demonstrations of each task; the third has too few, and of the last one only the first two show actions."""


def demo(task, number):
    """Makes a demonstration in which every entry tells its task, its demonstration and its step."""
    length = 5 + 3 * number + task
    step = np.arange(length)
    code = np.stack([np.full(length, task), np.full(length, number), step], axis=1).astype(np.float32)
    image = np.broadcast_to(code.astype(np.uint8)[:, None, None], (length, 4, 5, 3))
    return Demo(image, code, code[:, :2] + 0.5 if not (task == 3 and number > 1) else None)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded") / "set"
    with Writer(folder, (4, 5), 3, 2) as writer:
        for task, count in enumerate(DEMOS):
            demos = [demo(task, number) for number in range(count)]
            writer.add(f"task {task}", "train", [len(d.state) for d in demos], demos)
    return DataSet(folder)


def whole(data):
    return read_demos(data, range(4), [range(count) for count in DEMOS], HORIZON)


def test_loaded_demonstrations_are_resampled_and_the_rest_is_marked(data):
    loaded = whole(data)
    np.testing.assert_array_equal(loaded.there, [[d < count for d in range(4)] for count in DEMOS])
    np.testing.assert_array_equal(loaded.acts.sum(axis=1), [3, 2, 1, 2])
    for n, count in enumerate(DEMOS):
        for d in range(count):
            original = demo(n, d)
            index = spread(len(original.state), HORIZON)
            np.testing.assert_array_equal(loaded.demo.state[n, d], original.state[index])
            np.testing.assert_array_equal(loaded.demo.image[n, d], original.image[index])
            expected = np.zeros((HORIZON, 2)) if original.action is None else original.action[index]
            np.testing.assert_array_equal(loaded.demo.action[n, d], expected)


@pytest.mark.parametrize(("given_action", "pairs"), [(True, {(0, 1), (1, 0)}), (False, None)])
def test_batches_hold_different_demonstrations_of_one_task_and_queries_act(data, given_action, pairs):
    draw = jax.jit(lambda keys: sample_batch(jax.device_put(whole(data)), keys, 1, 3, None, 1.0, given_action, (2, 0)))
    batch = draw(jax.random.split(jax.random.key(0), 600))
    support, query = batch.support, batch.query
    assert support.state.shape == (600, 1, 3, 3)
    assert query.state.shape == (600, 1, HORIZON, 3)
    task = query.state[:, 0, 0, 0]
    np.testing.assert_array_equal(support.state[..., 0], np.broadcast_to(task[:, None, None], (600, 1, 3)))
    shown, asked = support.state[:, 0, 0, 1], query.state[:, 0, 0, 1]
    assert (shown != asked).all()
    np.testing.assert_array_equal(query.action, query.state[..., :2] + 0.5)
    np.testing.assert_array_equal(support.image[..., 0, 0, :], support.state.astype(np.uint8))
    # The goal is where the demonstration ends, at whichever step.
    last = np.array([[demo(int(t), int(q)).state[-1] for t, q in zip(task, asked, strict=True)]])[0]
    np.testing.assert_array_equal(query.goal[:, 0, 2], last[:, [2, 0]])
    assert set(task.tolist()) == {0.0, 1.0, 3.0}, "the task with one demonstration is never drawn"
    assert abs((task == 0).mean() - 1 / 3) < 4 * (2 / 9 / 600) ** 0.5
    drawn = {(int(s), int(q)) for s, q, t in zip(shown, asked, task, strict=True) if t == 3}
    assert drawn == (pairs or {(s, q) for s in range(4) for q in range(2) if s != q})


def test_a_set_that_fits_is_one_shard(data):
    shards = Shards(data, [0, 1, 3], HORIZON, 1.0, seed=0, acting=2)
    assert shards.whole
    first, later = shards.at(0), shards.at(7)
    assert first is later
    expected = read_demos(data, [0, 1, 3], [range(DEMOS[n]) for n in (0, 1, 3)], HORIZON)
    jax.tree.map(np.testing.assert_array_equal, first, expected)
    jax.tree.map(lambda a, b: (a.shape, a.dtype) == (b.shape, b.dtype) or pytest.fail(), first, shards.shapes)


def test_larger_sets_pass_by_in_shards_that_the_scan_determines(data, monkeypatch):
    monkeypatch.setattr(recorded_lib, "MOST_DEMOS", 2)
    size = sum(x.nbytes for x in jax.tree.leaves(read_demos(data, [0], [[0, 1]], HORIZON)))
    shards = Shards(data, [0, 1, 3], HORIZON, 2.5 * size / 2**30, seed=3, acting=2)
    assert (shards.num_tasks, shards.num_demos, shards.whole) == (2, 2, False)
    seen = []
    for scan in range(40):
        tasks, demos = shards.chosen(scan)
        assert len(set(tasks)) == 2
        found = shards.at(scan)
        for n, (task, numbers) in enumerate(zip(tasks, demos, strict=True)):
            for d, number in enumerate(numbers):
                np.testing.assert_array_equal(found.demo.state[n, d, 0, :2], [task, number])
                seen.append((task, number))
    counts = {pair: seen.count(pair) for pair in set(seen)}
    # Of the last task only the first two act, and a shard must have two that do.
    assert set(counts) == {(t, d) for t in (0, 1, 3) for d in range(min(DEMOS[t], 3 - t // 3))}, "everything passes by"
    resumed = Shards(data, [0, 1, 3], HORIZON, 2.5 * size / 2**30, seed=3, acting=2).at(39)
    jax.tree.map(np.testing.assert_array_equal, resumed, found)
    with pytest.raises(ValueError, match=r"recorded.gib: got 1e-09, expected at least"):
        Shards(data, [0, 1, 3], HORIZON, 1e-9, seed=3, acting=2)
