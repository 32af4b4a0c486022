"""Recorded demonstrations on the device, loaded while the scan before runs; batches like those of simulated ones."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from milx.data.augment import augmented
from milx.data.dataset import ALL_FIELDS, DataSet, spread
from milx.data.frames import frame_indices, next_frames, previous_frames
from milx.data.goals import with_goals
from milx.methods.history import stacked
from milx.types import Array, Demo, TaskBatch, by_field, from_fields

MOST_DEMOS = 16
"""Demonstrations of a task that are on the device at once; of more, some are drawn."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Recorded:
    """D demonstrations of each of N tasks, resampled to T time steps. Where a task has fewer, zeros fill the rest.

    Attributes:
        number: [N] int32, the tasks' numbers in the data set.
        demo: with leading axes [N, D, T]; actions are 0 where a demonstration shows none.
        there: [N, D] bool, whether it is a demonstration.
        acts: [N, D] bool, whether it is one that shows actions.
    """

    number: Array
    demo: Demo
    there: Array
    acts: Array


def read_later(
    data: DataSet,
    task: int,
    demo: int,
    horizon: int,
    chunk: int = 1,
    history: int = 1,
    fields: tuple[str, ...] = ALL_FIELDS,
) -> Callable[[], Demo]:
    """Starts reading a demonstration, resampled to T = `horizon` steps; the result is a function that waits for it.

    Its actions [T, chunk A] are those of the next `chunk` time steps before it was resampled; its images
    [T, H, W, 3 history] and states [T, history S] are those of the `history` time steps that end there, the latest
    first.
    """
    length = data.header.tasks[task].lengths[demo]
    frames = spread(length, horizon)
    fields = tuple(field for field in fields if field != "action")
    seen = data.read_later(task, demo, previous_frames(frames, history).ravel(), fields)
    done = data.read_later(task, demo, next_frames(frames, length, chunk).ravel(), ("action",))

    def finish() -> Demo:
        action, observed = done().action, seen()
        several = jax.tree.map(lambda x: x.reshape(horizon, history, *x.shape[1:]), (observed.image, observed.state))
        return Demo(*stacked(*several), None if action is None else action.reshape(horizon, -1))

    return finish


def shape_of(data: DataSet, num_tasks: int, num_demos: int, horizon: int, chunk: int, history: int) -> Recorded:
    """Returns shapes and types of `read_demos`'s result."""
    lead, head = (num_tasks, num_demos, horizon), data.header
    shapes = by_field(head.image_shape)
    channels = 3 * history
    image = from_fields(
        {name: jax.ShapeDtypeStruct((*lead, *size, channels), np.uint8) for name, size in shapes.items()}
    )
    sizes = history * head.state_size, chunk * head.action_size
    state, action = (jax.ShapeDtypeStruct((*lead, size), np.float32) for size in sizes)
    which = jax.ShapeDtypeStruct(lead[:2], np.bool_)
    return Recorded(jax.ShapeDtypeStruct((num_tasks,), np.int32), Demo(image, state, action), which, which)


def read_demos(
    data: DataSet,
    tasks: Sequence[int],
    demos: Sequence[Sequence[int]],
    horizon: int,
    chunk: int = 1,
    history: int = 1,
) -> Recorded:
    """Reads demonstrations, all at once, as NumPy arrays.

    Args:
        data: where from.
        tasks: N task numbers.
        demos: the numbers of the demonstrations of each; D is the most of them.
        horizon: T.
        chunk: time steps whose actions stand side by side.
        history: time steps whose observations do.
    """
    like = shape_of(data, len(tasks), max(len(chosen) for chosen in demos), horizon, chunk, history)
    whole = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), like)
    whole.number[:] = tasks
    pending = []
    for n, (task, chosen) in enumerate(zip(tasks, demos, strict=True)):
        for d, number in enumerate(chosen):
            pending.append((n, d, read_later(data, task, number, horizon, chunk, history)))
    for n, d, finish in pending:
        demo = finish()
        whole.there[n, d], whole.acts[n, d] = True, demo.action is not None
        read, room = (by_field(x.image) | {"state": x.state, "action": x.action} for x in (demo, whole.demo))
        for field, value in read.items():
            if value is not None:
                room[field][n, d] = value
    return whole


def sample_batch(
    recorded: Recorded,
    keys: jax.Array,
    shots: int,
    support_frames: int | None,
    query_frames: int | None,
    exponent: float,
    given_action: bool,
    goal_indices: tuple[int, ...],
    shift: int = 0,
    recolor: float = 0.0,
    crop: int = 0,
) -> TaskBatch:
    """Draws tasks and different demonstrations of each; the query is one that shows actions.

    Args:
        recorded: where to draw from.
        keys: [N] keys; each draws one task, with replacement, of those with enough demonstrations.
        shots: K, support demonstrations.
        support_frames: time steps drawn from each support demonstration; None for all.
        query_frames: time steps drawn from the query demonstration; None for all.
        exponent: see `frame_indices`.
        given_action: the support, too, must show actions.
        goal_indices: entries of the state that tell where the robot is (`milx.data.goals`).
        shift: random changes of the images, others for every demonstration (`milx.data.augment`).
        recolor: likewise.
        crop: likewise.
    """
    support = recorded.acts if given_action else recorded.there
    enough = (recorded.acts.any(axis=1) & (support.sum(axis=1) > shots)).astype(jnp.float32)
    horizon = recorded.demo.action.shape[2]

    def sample_task(key: jax.Array) -> TaskBatch:
        task_key, query_key, support_key, *frame_keys = jax.random.split(key, 4 + shots)
        n = jax.random.choice(task_key, len(enough), p=enough / enough.sum())
        acts = recorded.acts[n].astype(jnp.float32)
        query = jax.random.choice(query_key, len(acts), p=acts / acts.sum())
        others = support[n].astype(jnp.float32).at[query].set(0.0)
        chosen = jax.random.choice(support_key, len(acts), (shots,), replace=False, p=others / others.sum())

        def show(d: jax.Array, key: jax.Array, frames: int | None) -> Demo:
            index = frame_indices(key, horizon, frames, exponent)
            demo = jax.tree.map(lambda x: x[n, d], recorded.demo)
            drawn = jax.tree.map(lambda x: x[index], with_goals(demo, goal_indices))
            if not (shift or recolor or crop):
                return drawn
            image = augmented(drawn.image, jax.random.fold_in(key, 1), shift, recolor, crop)
            return dataclasses.replace(drawn, image=image)

        shown = [show(chosen[k], frame_keys[k], support_frames) for k in range(shots)]
        asked = show(query, frame_keys[shots], query_frames)
        return TaskBatch(
            support=jax.tree.map(lambda *xs: jnp.stack(xs), *shown),
            query=jax.tree.map(lambda x: x[None], asked),
            task=recorded.number[n],
        )

    return jax.vmap(sample_task)(keys)


class Shards:
    """What training draws its batches from: the whole split, or as much of it as fits, new for every scan.

    While one scan runs, the next one's shard is read and copied to the device. Which tasks and demonstrations are in
    it is a function of the seed and the scan.

    Args:
        data: the data set.
        tasks: numbers of the tasks to train on.
        horizon: T.
        gib: room for a shard; two are on the device at times.
        seed: draws the shards.
        acting: at least so many demonstrations of a task that show actions are in a shard, if it has as many.
        chunk: time steps whose actions stand side by side.
        history: time steps whose observations do.

    Raises:
        ValueError: if not even one task fits.
    """

    def __init__(
        self,
        data: DataSet,
        tasks: Sequence[int],
        horizon: int,
        gib: float,
        seed: int,
        acting: int,
        chunk: int = 1,
        history: int = 1,
    ):
        self.data, self.tasks, self.seed, self.acting = data, list(tasks), seed, acting
        self._sizes = horizon, chunk, history
        most = max(len(data.header.tasks[i].lengths) for i in self.tasks)
        self.num_demos = min(most, MOST_DEMOS)
        one = shape_of(data, 1, self.num_demos, *self._sizes)
        of_task = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(one))
        if of_task > gib * 2**30:
            raise ValueError(f"recorded.gib: got {gib}, expected at least {of_task / 2**30:.3g}, the size of a task")
        self.num_tasks = min(len(self.tasks), int(gib * 2**30 // of_task))
        self.whole = self.num_tasks == len(self.tasks) and most <= MOST_DEMOS
        self._pool = ThreadPoolExecutor(max_workers=1)
        self._coming: dict[int, Future[Recorded]] = {}

    @functools.cached_property
    def shapes(self) -> Recorded:
        """Shapes and types of a shard."""
        return shape_of(self.data, self.num_tasks, self.num_demos, *self._sizes)

    def at(self, scan: int) -> Recorded:
        """Returns the shard of a scan, and begins to read the next one's."""
        if self.whole:
            scan = 0
        for wanted in (scan, scan if self.whole else scan + 1):
            if wanted not in self._coming:
                self._coming[wanted] = self._pool.submit(self._load, wanted)
        self._coming = {number: future for number, future in self._coming.items() if number >= scan}
        return self._coming[scan].result()

    def _load(self, scan: int) -> Recorded:
        tasks, demos = self.chosen(scan)
        loaded = read_demos(self.data, tasks, demos, *self._sizes)
        fill = self.num_demos - loaded.there.shape[1]  # as large as every shard
        pad = lambda x: np.pad(x, [(0, 0), (0, fill)] + [(0, 0)] * (x.ndim - 2)) if x.ndim > 1 else x  # noqa: E731
        return jax.device_put(jax.tree.map(pad, loaded))

    def chosen(self, scan: int) -> tuple[list[int], list[list[int]]]:
        """Chooses the tasks of a shard and the demonstrations of each, and returns their numbers."""
        rng = np.random.default_rng([self.seed, scan])
        tasks = self.tasks if self.whole else rng.choice(self.tasks, self.num_tasks, replace=False).tolist()
        demos = []
        for task in tasks:
            order = rng.permutation(len(self.data.header.tasks[task].lengths))
            acts = np.array(self.data.header.tasks[task].has_action)[order]
            first = acts & (acts.cumsum() <= self.acting)
            demos.append(sorted(np.concatenate([order[first], order[~first]])[: self.num_demos].tolist()))
        return tasks, demos
