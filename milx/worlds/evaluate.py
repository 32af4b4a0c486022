"""Closed-loop evaluation of a policy in somebody else's world, beside controls that tell what its success rests on."""

import collections
import functools
import itertools
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from milx.config.schema import GIVEN
from milx.core.progress import advance
from milx.data.dataset import DataSet
from milx.deploy.policy import Policy
from milx.worlds.actor import CONTROLS, Actor
from milx.worlds.client import Client, WorldError
from milx.worlds.slot import Episode, Outcome, Slot, Task

FIRST_SEED = 1_000_000
"""Of the episodes, unless another is chosen."""


def tasks_of(data: DataSet, split: str | None, policy: Policy) -> list[Task]:
    """Lists the tasks of a split that have as many demonstrations as the policy's run was evaluated with.

    Args:
        data: the data set; the names of its tasks are those of the world.
        split: "train", "validation" or "test", or None for all tasks.
        policy: what is to be adapted.

    Raises:
        ValueError: if there is no such task.
    """
    shots, needs_action = policy.config.evaluation.shots, policy.config.method.given == GIVEN[0]
    tasks = []
    for number in range(len(data.header.tasks)) if split is None else data.header.of_split(split):
        info = data.header.tasks[number]
        shown = [i for i, has_action in enumerate(info.has_action) if has_action or not needs_action][:shots]
        if len(shown) == shots:
            tasks.append(Task(info.name, info.family, tuple(data.read(number, i) for i in shown)))
    if not tasks:
        kind = "task" if split is None else f"{split} task"
        raise ValueError(f"data: {data.folder} has no {kind} with {shots} demonstrations, expected at least one")
    return tasks


def evaluate_in(
    policy: Policy,
    make: str,
    tasks: Sequence[Task],
    *,
    controls: Sequence[str] = tuple(CONTROLS),
    episodes: int = 10,
    seed: int = FIRST_SEED,
    workers: int = 4,
    python: str = sys.executable,
    timeout: float = 60.0,
    max_steps: int = 1000,
    film: int = 0,
) -> list[Outcome]:
    """Runs episodes of every task with the policy and with controls.

    A world that fails costs its episode, and is started anew for the next one. One that cannot be started, even in
    several attempts, gets no more of them, and the other worlds run the rest.

    Args:
        policy: what is evaluated.
        make: "module:function", as `milx/worlds/worker.py` describes it.
        tasks: what is to be done.
        controls: keys of CONTROLS; those that a task does not have, for example because there is no other family, are
            left out.
        episodes: of every task and control, with the seeds `seed`, `seed` + 1 and so on, the same for all controls.
        seed: of the first episode, by default far from those of `milx.worlds.record`, which begin at 0: an episode must
            not start where its demonstration did. The world demonstrates with the seed before, modulo 2^31.
        workers: processes at once.
        python: the interpreter that runs the world.
        timeout: seconds that a world may take to answer. One that has not answered is ended, and its episode lost.
        max_steps: after which an episode ends, if the world does not end it.
        film: number of tasks for whose first episode after their own demonstrations the images are kept.

    Returns:
        What became of all episodes, in the order of tasks, controls and seeds. Those of a task that the world has
        failed to demonstrate are lost.

    Raises:
        WorldError: if no world can be started, no task can be demonstrated, or all of the first episodes, or all there
            are, are lost.
        ValueError: if there is no task, or for a control that does not exist.
    """
    if not tasks:
        raise ValueError("tasks: got none, expected at least one")
    if unknown := sorted(set(controls) - set(CONTROLS)):
        raise ValueError(f"controls: got {unknown[0]!r}, expected some of {', '.join(CONTROLS)}")
    controls = tuple(dict.fromkeys(controls))
    connect = functools.partial(Client, make, python, timeout)
    slots = [Slot(connect, policy.spec, max_steps) for _ in range(workers)]
    with ThreadPoolExecutor(workers) as pool:
        try:
            list(pool.map(Slot.start, slots))
            if all(slot.problem for slot in slots):
                raise WorldError(slots[0].problem)
            tasks, missing = _demonstrated(slots, tasks, (seed - 1) % 2**31)
            actor = Actor(policy, tasks, workers)
            possible = itertools.product(range(len(tasks)), controls, range(episodes))
            planned = [Episode(control, task, seed + i) for task, control, i in possible if actor.can(control, task)]
            filmed = {Episode("own", number, seed) for number in range(film)}
            outcomes = [
                Outcome(episode, lost=missing.get(episode.task), images=[] if episode in filmed else None)
                for episode in planned
            ]
            _run(pool, slots, actor, tasks, [outcome for outcome in outcomes if outcome.lost is None])
            return outcomes
        finally:  # before the pool waits for what the worlds are asked
            for slot in slots:
                slot.close()


def _demonstrated(slots: list[Slot], tasks: Sequence[Task], seed: int) -> tuple[list[Task], dict[int, str]]:
    """Lets a world demonstrate the tasks that have no demonstration.

    Returns:
        All tasks, and by the number of each that still has no demonstration, why.

    Raises:
        WorldError: if none has a demonstration.
    """
    shown, missing = list(tasks), dict[int, str]()
    for number, task in enumerate(tasks):
        for slot in slots:
            try:
                shown[number] = slot.demonstrated(task, seed)
            except WorldError as error:
                missing[number] = f"the task has no demonstration: {error}"
                if slot.problem is not None:  # another world may be there
                    continue
            else:
                missing.pop(number, None)
            break
    if len(missing) == len(tasks):
        raise WorldError(missing[0])
    return shown, missing


def _run(
    pool: ThreadPoolExecutor, slots: list[Slot], actor: Actor, tasks: Sequence[Task], outcomes: list[Outcome]
) -> None:
    """Runs the episodes of `outcomes`, as many at once as there are slots; if no world is left, the rest is lost.

    Raises:
        WorldError: if all of the first ones, at least ten, are lost, or all there are because no world is left.
    """
    waiting, ended = collections.deque(outcomes), list[Outcome]()
    while len(ended) < len(outcomes):
        if waiting:
            list(pool.map(Slot.start, slots))
        for number, slot in enumerate(slots):
            if slot.outcome is None and waiting and slot.problem is None:
                slot.outcome = waiting.popleft()
                actor.assign(number, slot.outcome.episode)
        if all(slot.problem for slot in slots):
            for outcome in waiting:
                outcome.lost = slots[0].problem
            if all(outcome.lost for outcome in outcomes):
                raise WorldError(f"all {len(outcomes)} episodes were lost: {outcomes[0].lost}")
            return
        list(pool.map(lambda slot: slot.begin(tasks), slots))
        actions = actor.act([slot.observation for slot in slots], [slot.outcome for slot in slots])
        list(pool.map(Slot.step, slots, actions))
        for slot in slots:
            if slot.outcome is not None and slot.is_over:
                ended.append(slot.outcome)
                slot.outcome = None
                advance(1)
        if max(10, 2 * len(slots)) <= len(ended) and all(outcome.lost for outcome in ended):
            raise WorldError(f"all of the first {len(ended)} episodes were lost: {ended[0].lost}")
