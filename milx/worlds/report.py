"""Evaluates a run in a world and reports: success by what acted, over all tasks and by family, and a video."""

import pathlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from milx.config import assemble
from milx.config.schema import Config
from milx.core import files, progress
from milx.core.messages import printable, warn
from milx.data.cameras import fitted
from milx.data.dataset import DataSet
from milx.deploy.policy import Policy, load_run
from milx.evaluation import provenance
from milx.evaluation.intervals import wilson_interval
from milx.evaluation.plots import side_by_side
from milx.networks.policy_network import goal_camera
from milx.worlds.actor import CONTROLS
from milx.worlds.evaluate import evaluate_in, tasks_of
from milx.worlds.slot import Outcome, Task

FILE, VIDEO = "gym.json", "gym.gif"
"""The files in the run's folder; those of another data set, NAME, are gym-NAME.json and gym-NAME.gif."""
_FILMED = 3
"""Tasks in the video."""


def report_on(
    config: Config,
    folder: pathlib.Path,
    make: str,
    console: Console | None = None,
    data: str | None = None,
    **options: Any,
) -> None:
    """Evaluates a run on the test tasks of its data set, or on all of another one's; prints a table, writes the files.

    Args:
        config: of the run.
        folder: the run's.
        make: "module:function", which makes the world.
        console: where to report.
        data: the folder of another data set; by default it is the run's.
        **options: further arguments of `evaluate_in`.

    Raises:
        ValueError: if the run is not on recorded demonstrations; if no task has enough demonstrations, or one of
            another data set's does not fit the policy. Also as `evaluate_in`.
        FileError: if a data set cannot be read.
    """
    if not config.recorded.path:
        raise ValueError(f"gym: {folder} is a run in simulation, expected one on recorded demonstrations")
    console, policy = console or Console(), load_run(folder)
    if data is None:
        tasks, file, video = tasks_of(DataSet(config.recorded.path), "test", policy), FILE, VIDEO
    else:
        name = pathlib.Path(data).resolve().name
        tasks, file, video = _tasks_of_another(data, policy), f"gym-{name}.json", f"gym-{name}.gif"
    with progress.phase(console, f"acting in {make}"):
        outcomes = evaluate_in(policy, make, tasks, film=_FILMED, **options)
    found = summarize(outcomes, tasks)
    files.write_json(
        folder / file,
        {
            "world": make,
            "criterion": "info['is_success'] or info['success'], at any time and at the end of an episode",
            "data": config.recorded.path if data is None else str(pathlib.Path(data).resolve()),
            "tasks": [task.name for task in tasks],
            "controls": found,
            "lost": losses(outcomes, tasks),
            "config": assemble.to_dict(config),
        }
        | provenance.origin(),
    )
    console.print(table(found))
    for loss in losses(outcomes, tasks):
        console.print(f"lost: {printable(loss)}", markup=False, highlight=False)
    filmed = [outcome for outcome in outcomes if outcome.images]
    if filmed:
        camera = goal_camera(policy.spec.image_shape)
        first = lambda image: image if camera is None else image[camera]  # noqa: E731
        shown = [fitted(tasks[outcome.episode.task].demos[0].image, policy.spec.image_shape) for outcome in filmed]
        demos = [np.asarray(first(images)) for images in shown]
        trials = [np.stack([first(image) for image in outcome.images or []]) for outcome in filmed]
        longest = max(map(len, demos + trials))
        side_by_side(_same_length(demos, longest), _same_length(trials, longest), folder / video)


def _tasks_of_another(folder: str, policy: Policy) -> list[Task]:
    """Lists all tasks of a data set on which the policy was not trained, and says how many have too few demonstrations.

    Raises:
        ValueError: as `tasks_of`, and for a demonstration that does not fit the policy.
    """
    data = DataSet(folder)
    tasks = tasks_of(data, None, policy)
    for task in tasks:
        for demo in task.demos:
            try:
                policy.prepared(demo)
            except ValueError as error:
                raise ValueError(f"data: {folder}, task {task.name}: {error}") from error
    if left_out := len(data.header.tasks) - len(tasks):
        expected = f"{policy.config.evaluation.shots} demonstrations that the policy can be adapted to"
        warn(f"data: {left_out} of the {len(data.header.tasks)} tasks of {folder} are left out, expected {expected}")
    return tasks


def summarize(outcomes: Sequence[Outcome], tasks: Sequence[Task]) -> dict[str, Any]:
    """Summarizes episodes for a result file.

    Args:
        outcomes: of `evaluate_in`.
        tasks: those that it was given.

    Returns:
        By key of CONTROLS, the number of "episodes", how many were "lost", the success rates at any time ("ever") and
        at the "end" with their 95% intervals by Wilson, the mean number of "steps", and the same by "families". A lost
        episode counts as one without success.
    """
    found = {}
    for control in CONTROLS:
        mine = [outcome for outcome in outcomes if outcome.episode.control == control]
        if mine:
            families = sorted({tasks[outcome.episode.task].family for outcome in mine})
            of = lambda family: [o for o in mine if tasks[o.episode.task].family == family]  # noqa: B023, E731
            found[control] = _rates(mine) | {"families": {family: _rates(of(family)) for family in families}}
    return found


def _same_length(clips: Sequence[np.ndarray], length: int) -> np.ndarray:
    """Repeats the last images of clips [T, H, W, 3]."""
    return np.stack([clip[np.minimum(np.arange(length), len(clip) - 1)] for clip in clips])


def _rates(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    count = len(outcomes)
    rates: dict[str, Any] = {
        "episodes": count,
        "lost": sum(outcome.lost is not None for outcome in outcomes),
        "steps": sum(outcome.steps for outcome in outcomes) / count,
    }
    for name in ("ever", "end"):
        successes = sum(getattr(outcome, name) for outcome in outcomes)
        rates[name] = successes / count
        rates[f"{name}_wilson95"] = wilson_interval(successes, count)
    return rates


def table(found: dict[str, Any]) -> Table:
    """Draws a summary: a line for everything that acted, a column of success at any time for every family."""
    families = list(next(iter(found.values()))["families"])
    shown = families if len(families) > 1 else []
    drawn = Table("after", "success (95%)", "at the end (95%)", "episodes")
    for family in shown:
        drawn.add_column(Text(printable(family)))
    for column in drawn.columns:
        column.overflow = "fold"  # a narrow console gets more lines, and all words
    for control, rates in found.items():
        lost = f", {rates['lost']} lost" if rates["lost"] else ""
        drawn.add_row(
            CONTROLS[control],
            *(_with_interval(rates, name) for name in ("ever", "end")),
            f"{rates['episodes']}{lost}",
            *(_of_family(rates, family) for family in shown),
        )
    return drawn


def losses(outcomes: Iterable[Outcome], tasks: Sequence[Task]) -> list[str]:
    """Says of every lost episode why it was lost."""
    return [
        f"{tasks[outcome.episode.task].name}, {outcome.episode.control}, seed {outcome.episode.seed}: {outcome.lost}"
        for outcome in outcomes
        if outcome.lost is not None
    ]


def _with_interval(rates: dict[str, Any], name: str) -> str:
    low, high = rates[f"{name}_wilson95"]
    return f"{rates[name]:.1%} ({100 * low:.0f} to {100 * high:.0f})"


def _of_family(rates: dict[str, Any], family: str) -> str:
    """A control may not exist in a family."""
    return _with_interval(rates["families"][family], "ever") if family in rates["families"] else ""
