"""Evaluates a run's best checkpoint again on held-out tasks, or in a world of your own.

    python -m milx.evaluate runs/reach-mil-fast-0
    python -m milx.evaluate runs/my_arm-mil-fast-0 --gym=my_world:make
    python -m milx.evaluate runs/my_arm-mil-fast-0 --gym=my_world:make --data=new_tasks

The first command writes evaluation.json and the plot in the run's folder anew, and the video if the run is in
simulation.

The second one is for runs on recorded demonstrations. `my_world.make(task)` returns a Gymnasium environment for a
held-out task of the data set; the policy is adapted to the task's demonstrations and acts there, beside controls. It
writes gym.json, and gym.gif where the policy sees images. `milx/worlds/worker.py` describes what the environment must
be like; it runs in processes of its own, which need NumPy, Gymnasium and your code alone (--python).

The third one does the same with all tasks of another data set, which should be new to the policy; your own expert may
have recorded it in that world (`milx.worlds.record`). It writes gym-new_tasks.json and gym-new_tasks.gif.
"""

import pathlib
import sys
from typing import Any

from absl import app, flags, logging

from milx.config import assemble
from milx.config.registry import load_plugins
from milx.core import platform
from milx.core.commands import command
from milx.training.factory import make_run
from milx.worlds.report import report_on

_GYM = flags.DEFINE_string("gym", None, "A function that makes Gymnasium environments, as module:function.")
_DATA = flags.DEFINE_string("data", None, "With --gym: another data set, whose tasks are all tried.")
_PYTHON = flags.DEFINE_string("python", sys.executable, "With --gym: the interpreter that runs the environments.")
_WORKERS = flags.DEFINE_integer("workers", 4, "With --gym: environments at once.", lower_bound=1)
_EPISODES = flags.DEFINE_integer("episodes", 10, "With --gym: episodes of every task and control.", lower_bound=1)
_TIMEOUT = flags.DEFINE_float("timeout", 60.0, "With --gym: seconds that an environment may take to answer.")


def main(argv: list[str]) -> None:
    """Evaluates the run RUN."""
    if len(argv) != 2:
        raise app.UsageError("expected one argument, RUN")
    logging.set_verbosity(logging.ERROR)  # Orbax warns of things that milx does on purpose
    platform.configure()
    load_plugins()
    path = pathlib.Path(argv[1]) / "config.json"
    with command():
        if _DATA.value is not None and _GYM.value is None:
            raise ValueError(f"data: got {_DATA.value!r} without --gym, expected the world in which to try its tasks")
        if not path.is_file():
            raise ValueError(f"run: {path.parent} has no config.json, expected a folder of `python -m milx.train`")
        platform.require_device()
        config = assemble.read(path)
        if _GYM.value is None:
            run = make_run(config, path.parent)
            run.report(run.evaluate())
        else:
            options: dict[str, Any] = {"episodes": _EPISODES.value, "workers": _WORKERS.value}
            options |= {"data": _DATA.value, "python": _PYTHON.value, "timeout": _TIMEOUT.value}
            report_on(config, path.parent, _GYM.value, **options)


if __name__ == "__main__":
    app.run(main)
