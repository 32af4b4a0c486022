"""What importers share: which episodes make a task, which tasks make a split, and writing them down."""

import pathlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
from absl import app, flags
from rich.progress import track

from milx.core.commands import command
from milx.data import cameras, splits
from milx.data.dataset import Writer
from milx.data.splits import PREFIX
from milx.types import Demo, ImageShape

FLAGS = flags.FLAGS


class Episode(NamedTuple):
    """One demonstration of a source.

    Attributes:
        task: the name of its task.
        length: its time steps.
        has_action: whether it shows actions.
        read: reads its arrays; images may be larger than the data set's.
        instruction: what the source says was to be done; "" for nothing.
    """

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


class Source(Protocol):
    """What an importer makes of the files of others."""

    contents: Contents

    def episodes(self, task: str) -> list[Episode]:
        """Lists all episodes; `task` says what makes a task."""


def define_flags(*, state: str, action: str, task: str) -> None:
    """Defines the flags of an importer's command line, with these defaults."""
    camera = "Where the images are; several cameras separated by commas, the only one if not given, none if empty."
    flags.DEFINE_string("camera", None, camera)
    parts = "Where the robot's state is; several parts separated by commas, empty for none."
    flags.DEFINE_string("state", state, parts)
    flags.DEFINE_string("action", action, "Where the actions are; empty for none.")
    flags.DEFINE_string("task", task, "What makes a task: see above.")
    define_split_flags()


def define_split_flags() -> None:
    """Defines the flags about images and splits that importers and recorders share."""
    flags.DEFINE_integer("height", 128, "Maximum number of rows of an image; larger ones are shrunk.", lower_bound=1)
    flags.DEFINE_float("validation", 0.1, "Fraction of the tasks that becomes validation tasks.")
    flags.DEFINE_float("test", 0.1, "Fraction of the tasks that becomes test tasks.")
    family = f"What tasks have in common: {PREFIX!r}, the part of the names before the first '/', or a JSON file that "
    family += "maps names of tasks to families; none if empty. Each family is split by itself."
    flags.DEFINE_string("family", "", family)
    chosen = "A JSON file with the names, or patterns such as 'drawer/*', of the tasks of the splits 'validation' and "
    flags.DEFINE_string("splits", None, chosen + "'test', in the place of fractions.")


def run(argv: list[str], open_source: Callable[[str, Any], Source]) -> None:
    """Runs the command line of an importer: PATH OUT; bad input ends with a message, not a traceback.

    Args:
        argv: the name of the program, PATH and OUT.
        open_source: opens PATH with the values of the flags.

    Raises:
        absl.app.UsageError: for another number of arguments.
        SystemExit: if the files cannot be read or imported; the message says why.
    """
    if len(argv) != 3:
        raise app.UsageError("expected two arguments, PATH and OUT")
    with command():
        source = open_source(argv[1], FLAGS)
        episodes = source.episodes(FLAGS.task)
        families = splits.families_of({episode.task for episode in episodes}, FLAGS.family)
        chosen = None if FLAGS.splits is None else splits.read_patterns(FLAGS.splits)
        write(argv[2], episodes, source.contents, (FLAGS.validation, FLAGS.test), argv[1], families, chosen)
        print(f"{argv[2]}: look at it with `python -m milx.data.check {argv[2]}`")


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
            demos = (_as_written(episode, contents) for episode in own)
            lengths, said = [episode.length for episode in own], [episode.instruction for episode in own]
            writer.add(name, split_of[name], lengths, demos, families[name], said)


def _as_written(episode: Episode, contents: Contents) -> Demo:
    demo = episode.read()
    action = None if demo.action is None else np.asarray(demo.action, np.float32)
    state = np.asarray(demo.state, np.float32) if contents.state_size else None
    return Demo(cameras.fitted(demo.image, contents.image_shape), state, action)
