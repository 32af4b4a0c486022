"""Looks at a data set and says what will go wrong: python -m milx.data.check PATH."""

import collections

import numpy as np
from absl import app
from rich.console import Console
from rich.table import Table

from milx.config.schema import GIVEN
from milx.core.commands import command
from milx.core.messages import printable
from milx.data.dataset import LARGEST, DataSet, check_size
from milx.data.header import Header
from milx.methods.whitening import MIN_STD
from milx.types import SPLITS, by_field

MANY_ROWS = 256
"""Images with more rows than this are slow to learn from."""
FEW_TASKS = 20
"""With fewer training tasks, meta-learning has little to learn from."""
_SPREAD = 3
"""Times that the longest demonstration is longer than the shortest, beyond which resampling distorts."""


def problems(data: DataSet) -> list[str]:
    """Finds what will go wrong, a sentence each, the worst first; reads all states, all actions and first images."""
    head, read = data.header, vectors(data)
    found = [*_refusals(data), *_disappointments(head)]
    for field, values in read.items():
        finite = values[np.isfinite(values).all(axis=1)]
        for i in np.flatnonzero(finite.std(axis=0) < MIN_STD).tolist() if len(finite) else ():
            found.append(f"{head.entry(field, i)} is constant: it says nothing")
    found += _classes(head, read.get("action", np.zeros((0, head.action_size))))
    for number, task in enumerate(head.tasks):
        if head.image_shape is not None and task.lengths:
            seen = data.read(number, 0, np.zeros(1, int), fields=("image",)).image
            for name, image in by_field(seen).items():
                if image.min() == image.max():
                    found.append(f"task {task.name!r}: the first {name} is of one color")
    return found


def _refusals(data: DataSet) -> list[str]:
    """Finds what training refuses."""
    found, head = [], data.header
    for split in SPLITS:
        if not head.of_split(split):
            found.append(f"no {split} tasks: training refuses this data set")
        elif not any(head.tasks[i].suffices(1, given_action=True) for i in head.of_split(split)):
            unless = ""
            if any(head.tasks[i].suffices(1, given_action=False) for i in head.of_split(split)):
                unless = f" unless method.given is {' or '.join(GIVEN[1:])}"
            found.append(f"no {split} task with two demonstrations that show actions: training refuses this{unless}")
    for number, task in enumerate(head.tasks):
        if len(task.lengths) < 2:
            found.append(f"task {task.name!r} has {len(task.lengths)} demonstration: one more must be the query")
        elif not any(task.has_action):
            found.append(f"task {task.name!r} shows no actions: it cannot be learned from")
        for demo in range(len(task.lengths)):
            read = data.read(number, demo, fields=("state", "action"))
            for field, values in (("state", read.state), ("action", read.action)):
                if values is None or (np.abs(values) <= LARGEST).all():
                    continue
                step, i = np.argwhere(~(np.abs(values) <= LARGEST))[0].tolist()
                where = f"demonstration {demo} of task {task.name!r}, time step {step}"
                found.append(f"{head.entry(field, i)} is {values[step, i]} in {where}: training refuses this")
    return found


def _classes(head: Header, actions: np.ndarray) -> list[str]:
    """Finds entries of the actions that take two values and are not marked so, and the opposite."""
    found = []
    for i in range(head.action_size):
        count, name = len(np.unique(actions[:, i])), head.entry("action", i)
        if i in head.class_indices and count > 2:
            found.append(f"{name} is marked as taking two values and has {count}: only the outermost will be done")
        elif i not in head.class_indices and count == 2:
            found.append(f"{name} takes two values: import it with --classes={i}, and they are learned as classes")
    return found


def _disappointments(head: Header) -> list[str]:
    """Finds what training accepts and what is likely to disappoint."""
    found = []
    training = head.of_split("train")
    if len(training) < FEW_TASKS:
        found.append(f"{len(training)} training tasks: with fewer than about {FEW_TASKS}, new tasks are hardly learned")
    names = {task.name for task in head.tasks}
    if names and len(names) < FEW_TASKS and all(set(task.instructions) == {task.name} for task in head.tasks):
        found.append("every task is one sentence: if goals or objects differ within it, say so with --task=tasks.json")
    families = {task.family for task in head.tasks}
    for split in SPLITS[1:]:
        held_out = {head.tasks[i].family for i in head.of_split(split)}
        if len(held_out) == 1 and len(families) > 1:
            found.append(f"all {split} tasks are of the family {held_out.pop()!r}: they say nothing of the others")
    lengths = [length for task in head.tasks for length in task.lengths]
    if lengths and max(lengths) > _SPREAD * min(lengths):
        found.append(f"lengths from {min(lengths)} to {max(lengths)} steps: all are resampled to recorded.horizon")
    if head.image_shape is None:
        found.append("no images: " + ("policies see states only" if head.state_size else "policies see nothing at all"))
    for name, size in by_field(head.image_shape).items():
        if size[0] > MANY_ROWS:
            found.append(f"{name} of {size[0]} x {size[1]}: import it with fewer rows (--height)")
    return found


def vectors(data: DataSet) -> dict[str, np.ndarray]:
    """Reads all states [F, S] and actions [F', A].

    Raises:
        ValueError: if they are too large for the memory.
    """
    steps = sum(sum(task.lengths) for task in data.header.tasks)
    check_size(f"{data.folder}: states and actions", (steps, data.header.state_size + data.header.action_size), 4)
    rows: dict[str, list[np.ndarray]] = {"state": [], "action": []}
    for number, task in enumerate(data.header.tasks):
        for demo in range(len(task.lengths)):
            read = data.read(number, demo, fields=("state", "action"))
            for field, values in rows.items():
                if (value := getattr(read, field)) is not None:
                    values.append(value)
    return {field: np.concatenate(values) for field, values in rows.items() if values}


def describe(data: DataSet, console: Console) -> None:
    """Prints tasks, demonstrations, lengths and ranges."""
    head = data.header
    lengths = [length for task in head.tasks for length in task.lengths]
    console.print(
        f"{printable(str(data.folder))}: {len(head.tasks)} tasks, {len(lengths)} demonstrations, "
        f"from {printable(head.source) or 'unknown'}"
    )
    sizes = [f"{name} {size[0]} x {size[1]}" for name, size in by_field(head.image_shape).items()]
    image = ", ".join(sizes) or "no images"
    if lengths:
        median, rate = int(np.median(lengths)), "" if head.fps is None else f", {head.fps:g} a second"
        console.print(f"{image}; {min(lengths)} to {max(lengths)} steps, half of them at most {median}{rate}")
    for split in SPLITS:
        names = [printable(head.tasks[i].name) for i in head.of_split(split)]
        console.print(
            f"{split}: {len(names)} tasks{': ' if names else ''}{', '.join(names[:5])}{' ...' if names[5:] else ''}"
        )
    families = collections.Counter(task.family for task in head.tasks)
    if set(families) != {""}:
        counted = (f"{printable(family)} ({count})" for family, count in sorted(families.items()))
        console.print(f"families: {', '.join(counted)}")
    table = Table("", "minimum", "mean", "maximum", "standard deviation")
    for field, values in vectors(data).items():
        with np.errstate(invalid="ignore"):
            for i, column in enumerate(values.T):
                shown = (np.nanmin(column), np.nanmean(column), np.nanmax(column), np.nanstd(column))
                table.add_row(printable(head.entry(field, i)), *(f"{value:.4g}" for value in shown))
    console.print(table)


def main(argv: list[str]) -> None:
    """Prints what a data set holds, and its problems."""
    if len(argv) != 2:
        raise app.UsageError("expected one argument, PATH")
    with command():
        console = Console(markup=False)  # the names of tasks may look like markup
        data = DataSet(argv[1])
        describe(data, console)
        found = problems(data)
        for problem in found:
            console.print(f"- {printable(problem)}")
        if not found:
            console.print("nothing seems wrong")


if __name__ == "__main__":
    app.run(main)
