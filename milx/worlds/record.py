"""Records demonstrations in a Gymnasium environment that can show its tasks itself.

    python -m milx.worlds.record my_world:make OUT --demos=4 --family=prefix

`my_world.make(task)` returns an environment with a method `demonstrate(seed)`, and `my_world.tasks()` lists the names
of all tasks; `milx/worlds/worker.py` describes both. The environments run in processes of their own, which need NumPy,
Gymnasium and your code alone (--python). A task that cannot be shown often enough is left out and reported.
"""

import collections
import functools
import itertools
import pathlib
import queue
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from absl import app, flags
from rich.progress import track

from milx.core.commands import command
from milx.core.messages import warn
from milx.data import command_line, splits
from milx.data.cameras import fitted, shrunk
from milx.data.dataset import Writer
from milx.types import Demo, by_field, from_fields
from milx.worlds.client import Client, WorldError

_ATTEMPTS = 2
"""Seeds that are tried for every demonstration, on average."""


class Recorded(NamedTuple):
    """The demonstrations of a task, [T, ...] each, why there are not more of them, and their time steps in a second."""

    task: str
    demos: list[Demo]
    problem: str
    fps: float | None = None


def record(connect: Callable[[], Client], tasks: Sequence[str], demos: int, workers: int) -> Iterator[Recorded]:
    """Lets worlds show their tasks.

    Args:
        connect: starts a world.
        tasks: names, in the order of the results.
        demos: demonstrations of each task, with the seeds 0, 1 and so on; those that fail are replaced by later ones.
        workers: worlds at once.

    Yields:
        What was recorded of every task.
    """
    idle: queue.SimpleQueue[Client | None] = queue.SimpleQueue()
    for _ in range(workers):
        idle.put(None)

    def show(task: str) -> Recorded:
        client, shown, problem, fps = idle.get(), list[Demo](), "", None
        try:
            for seed in range(_ATTEMPTS * demos):
                if len(shown) == demos:
                    break
                try:
                    client = client or connect()
                    header, arrays = client.ask({"do": "demonstrate", "task": task, "seed": seed})
                    shown.append(_demo(task, arrays))
                    fps = header.get("fps")
                except WorldError as error:
                    if client is not None:
                        client.close()
                    client, problem = None, str(error)
        finally:  # whatever happens, `record` waits for all of them at its end
            idle.put(client)
        return Recorded(task, shown, problem, fps)

    waiting, under_way = collections.deque(tasks), collections.deque[Future[Recorded]]()
    try:
        with ThreadPoolExecutor(workers) as pool:
            while waiting or under_way:
                while waiting and len(under_way) < 2 * workers:  # what is not written yet is kept in memory
                    under_way.append(pool.submit(show, waiting.popleft()))
                yield under_way.popleft().result()
    finally:
        for _ in range(workers):
            if (client := idle.get()) is not None:
                client.close()


def write(
    out: str | pathlib.Path,
    recorded: Iterator[Recorded],
    split_of: dict[str, str],
    families: dict[str, str],
    demos: int,
    height: int,
    source: str,
) -> None:
    """Writes what was recorded as a data set; tasks with fewer than `demos` demonstrations are left out and reported.

    Args:
        out: the folder; must not exist.
        recorded: the results of `record`; the first one's rate is that of the data set.
        split_of: the split of every task.
        families: the family of every task.
        demos: demonstrations that a task needs.
        height: maximum number of rows of an image; larger ones are shrunk.
        source: where they come from.

    Raises:
        ValueError: if no task could be shown often enough, or demonstrations differ in their sizes.
    """
    kept = (each for each in recorded if _is_complete(each, demos))
    first = next(kept, None)
    if first is None:
        raise ValueError(f"{source}: no task could be shown {demos} times, expected at least one")
    image, state, action = (getattr(first.demos[0], field) for field in ("image", "state", "action"))
    shape = from_fields({name: shrunk(each.shape[1:3], height) for name, each in by_field(image).items()})
    sizes = shape, 0 if state is None else state.shape[1], action.shape[1]
    with Writer(out, *sizes, source, first.fps) as writer:
        for task, shown, *_ in itertools.chain([first], kept):
            fitting = [Demo(fitted(demo.image, shape), demo.state, demo.action) for demo in shown]
            writer.add(task, split_of[task], [len(demo.action) for demo in shown], fitting, families[task])


def _is_complete(recorded: Recorded, demos: int) -> bool:
    if len(recorded.demos) < demos:
        warn(f"{recorded.task} is left out, {len(recorded.demos)} of {demos} demonstrations: {recorded.problem}")
    return len(recorded.demos) == demos


def _demo(task: str, arrays: dict[str, np.ndarray]) -> Demo:
    if "action" not in arrays:
        raise WorldError(f"{task}: demonstrate returned {sorted(arrays)}, expected an action, at least")
    return Demo(from_fields(arrays), arrays.get("state"), arrays["action"])


def main(argv: list[str]) -> None:
    """Records the world MAKE as OUT."""
    if len(argv) != 3:
        raise app.UsageError("expected two arguments, MAKE and OUT")
    values = flags.FLAGS
    make, out = argv[1:]
    with command():
        connect = functools.partial(Client, make, values.python, values.timeout)
        client = connect()
        tasks = sorted(client.ask({"do": "tasks"})[0]["tasks"])
        client.close()
        families = splits.families_of(tasks, values.family)
        if values.splits is None:
            split_of = splits.by_family(families, values.validation, values.test)
        else:
            split_of = splits.choose(tasks, splits.read_patterns(values.splits))
        recorded = track(record(connect, tasks, values.demos, values.workers), "recording tasks", len(tasks))
        write(out, iter(recorded), split_of, families, values.demos, values.height, make)
        print(f"{out}: look at it with `python -m milx.data.check {out}`")


if __name__ == "__main__":
    flags.DEFINE_integer("demos", 4, "Demonstrations of every task.", lower_bound=1)
    flags.DEFINE_string("python", sys.executable, "The interpreter that runs the environments.")
    flags.DEFINE_integer("workers", 4, "Environments at once.", lower_bound=1)
    flags.DEFINE_float("timeout", 60.0, "Seconds that a demonstration may take.")
    command_line.define_split_flags()
    app.run(main)
