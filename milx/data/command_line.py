"""The command line that importers share, PATH OUT and flags; recorders share the flags about images and splits."""

from collections.abc import Callable
from typing import Any

from absl import app, flags

from milx.core.commands import command
from milx.data import episodes, splits
from milx.data.episodes import Source
from milx.data.splits import PREFIX

FLAGS = flags.FLAGS
flags.disclaim_key_flags()  # so that --help of an importer lists the flags defined here


def define_flags(*, state: str, action: str, task: str) -> None:
    """Defines the flags of an importer's command line, with these defaults."""
    camera = "Where the images are; several cameras separated by commas, the only one if not given, none if empty."
    flags.DEFINE_string("camera", None, camera)
    parts = "Where the robot's state is; several parts separated by commas, empty for none."
    flags.DEFINE_string("state", state, parts)
    flags.DEFINE_string("action", action, "Where the actions are; empty for none.")
    flags.DEFINE_string("task", task, "What makes a task: see above.")
    two = "Entries of the action that take two values, such as a gripper's, by name or index, separated by commas."
    flags.DEFINE_string("classes", "", two)
    some = "Episodes to import, separated by commas: names, numbers, 0-99, or patterns like 'lift/*'; all if empty."
    flags.DEFINE_string("episodes", "", some)
    bad = "Leave out episodes that cannot be read or hold numbers that are not finite, and report them."
    flags.DEFINE_bool("skip_bad", False, bad)
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
        found = episodes.selected(source.episodes(FLAGS.task), FLAGS.episodes)
        contents = episodes.with_classes(source.contents, FLAGS.classes)
        if FLAGS.skip_bad:
            found = episodes.readable(found, contents)
        families = splits.families_of({episode.task for episode in found}, FLAGS.family)
        chosen = None if FLAGS.splits is None else splits.read_patterns(FLAGS.splits)
        episodes.write(argv[2], found, contents, (FLAGS.validation, FLAGS.test), argv[1], families, chosen)
        print(f"{argv[2]}: look at it with `python -m milx.data.check {argv[2]}`")
