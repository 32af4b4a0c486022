"""What importers share: which episodes make a task, which tasks make a split, and writing them down."""

import fnmatch
import pathlib
import re
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple, Protocol

import numpy as np
from rich.progress import track

from milx.core.messages import warn
from milx.data import cameras, splits
from milx.data.dataset import LARGEST, Writer
from milx.data.header import named_entry
from milx.types import Demo, ImageShape


class Episode(NamedTuple):
    """One demonstration of a source.

    Attributes:
        name: what the source calls it, by number or by name.
        task: the name of its task.
        length: its time steps; 0 if it cannot be read, and `read` says why.
        has_action: whether it shows actions.
        read: reads its arrays; images may be larger than the data set's.
        instruction: what the source says was to be done; "" for nothing.
    """

    name: str
    task: str
    length: int
    has_action: bool
    read: Callable[[], Demo]
    instruction: str = ""


class Contents(NamedTuple):
    """What all episodes of a source show, as in a data set's header."""

    image_shape: ImageShape
    state_size: int
    action_size: int
    fps: float | None = None
    state_names: tuple[str, ...] = ()
    action_names: tuple[str, ...] = ()
    class_indices: tuple[int, ...] = ()


class Source(Protocol):
    """What an importer makes of the files of others."""

    contents: Contents

    def episodes(self, task: str) -> list[Episode]:
        """Lists all episodes; `task` says what makes a task."""


def with_classes(contents: Contents, wanted: str) -> Contents:
    """Marks entries of the action, by name or index, separated by commas, as those that take two values.

    Raises:
        ValueError: for an entry that does not exist.
    """
    names = contents.action_names or tuple(map(str, range(contents.action_size)))
    known = {str(i): i for i in range(contents.action_size)} | {name: i for i, name in enumerate(names)}
    entries = [entry for entry in wanted.split(",") if entry]
    if unknown := [entry for entry in entries if entry not in known]:
        raise ValueError(f"classes: got {unknown[0]!r}, expected some of {', '.join(names)}, or their indices")
    return contents._replace(class_indices=tuple(dict.fromkeys(known[entry] for entry in entries)))


def selected(episodes: Iterable[Episode], wanted: str) -> list[Episode]:
    """Selects episodes by names, ranges of numbers, or patterns, separated by commas; all if nothing is wanted.

    Raises:
        ValueError: for one of these that fits no episode.
    """
    patterns, found = [pattern for pattern in wanted.split(",") if pattern], list(episodes)
    for pattern in patterns:
        if not any(_fits(episode.name, pattern) for episode in found):
            names = ", ".join(episode.name for episode in found[:5])
            raise ValueError(f"episodes: got {pattern!r}, which fits none, expected names such as {names}")
    return [each for each in found if not patterns or any(_fits(each.name, pattern) for pattern in patterns)]


def _fits(name: str, pattern: str) -> bool:
    numbers = re.fullmatch(r"(\d+)-(\d+)", pattern)
    if numbers and name.isdecimal():
        return int(numbers[1]) <= int(name) <= int(numbers[2])
    return name == pattern or fnmatch.fnmatchcase(name, pattern)


def readable(episodes: Iterable[Episode], contents: Contents) -> list[Episode]:
    """Reads all episodes, and leaves out and reports those for which `checked` raises an error."""
    kept = []
    for episode in track(list(episodes), "reading episodes"):
        try:
            checked(episode, contents)
        except (ValueError, OSError) as error:
            warn(f"episode {episode.name} is left out: {error}")
            continue
        kept.append(episode)
    return kept


def checked(episode: Episode, contents: Contents) -> Demo:
    """Reads an episode, with states and actions in float32.

    Raises:
        ValueError: if it cannot be read, has other sizes, or holds a number that is not finite in float32 or beyond
            LARGEST; the message names the entry, the episode and the time step.
    """
    demo = episode.read()
    vectors = {"state": demo.state if contents.state_size else None, "action": demo.action}
    for field, value in vectors.items():
        if value is None:
            continue
        with np.errstate(over="ignore"):
            value = vectors[field] = np.asarray(value, np.float32)
        expected = (episode.length, getattr(contents, f"{field}_size"))
        if value.shape != expected:
            got = f"got shape {list(value.shape)}, expected {list(expected)}"
            raise ValueError(f"{field} of episode {episode.name}: {got} (--skip_bad leaves it out)")
        if not (np.abs(value) <= LARGEST).all():
            step, index = np.argwhere(~(np.abs(value) <= LARGEST))[0].tolist()
            where = named_entry(field, index, getattr(contents, f"{field}_names"))
            got = f"got {value[step, index]} at time step {step}, expected finite numbers"
            most = f"of magnitude at most {LARGEST:.0e} (--skip_bad leaves it out)"
            raise ValueError(f"{where} of episode {episode.name}: {got} {most}")
    return Demo(cameras.fitted(demo.image, contents.image_shape), **vectors)


def write(
    out: str | pathlib.Path,
    episodes: Iterable[Episode],
    contents: Contents,
    held_out: tuple[float, float],
    source: str,
    families: Mapping[str, str] | None = None,
    chosen: Mapping[str, list[str]] | None = None,
) -> None:
    """Writes episodes as a data set (`milx.data.dataset`), its tasks in the order of their names.

    Args:
        out: the folder; must not exist.
        episodes: all of them, in any order.
        contents: what they show.
        held_out: the fractions of the tasks that become validation and test tasks.
        source: where they come from.
        families: of the tasks, by name; none if not given.
        chosen: patterns of the names of validation and test tasks, by split, in the place of `held_out`.

    Raises:
        ValueError: for fractions or patterns as `milx.data.splits` refuses them, or an episode that does not fit the
            contents.
    """
    tasks: dict[str, list[Episode]] = {}
    for episode in episodes:
        tasks.setdefault(episode.task, []).append(episode)
    families = families or dict.fromkeys(tasks, "")
    split_of = splits.choose(sorted(tasks), chosen) if chosen is not None else splits.by_family(families, *held_out)
    with Writer(out, source=source, **contents._asdict()) as writer:
        for name in track(sorted(tasks), "writing tasks"):
            own = tasks[name]
            for broken in (episode for episode in own if not episode.length):
                broken.read()  # says what is wrong with it
            demos = (checked(episode, contents) for episode in own)
            lengths, said = [episode.length for episode in own], [episode.instruction for episode in own]
            writer.add(name, split_of[name], lengths, demos, families[name], said)
