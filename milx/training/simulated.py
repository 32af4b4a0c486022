"""Runs in a simulated environment: planned demonstrations, and success in closed-loop trials on held-out tasks.

A run's folder then holds a video, too: rollouts.gif.
"""

import functools
import math
import pathlib
import sys
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from rich.console import Console

from milx import envs
from milx.config.check import check_config
from milx.config.schema import Config, EvalConfig
from milx.core import parallel, platform, pytrees
from milx.data import simulated as demos_lib
from milx.data.frames import in_chunks
from milx.data.simulated import DemoSet
from milx.envs.base import State, Task
from milx.evaluation import closed_loop, plots
from milx.evaluation.closed_loop import Trials
from milx.methods import Method, whitening
from milx.methods.random import Random
from milx.training.metrics import read_metrics
from milx.training.run import Run
from milx.training.state import Training
from milx.types import SPLITS, Params

EVALUATION_SEED = 2017
"""Validation and test tasks and their trials are the same for every seed of a run."""
VIDEO = "rollouts.gif"
"""The video's file in the run's folder."""
_FILMED = 3
"""Tasks that it shows."""
_LARGE = 256
"""Height of its images (pixels), at most, unless policies see larger ones."""


def size_of_split(config: Config, split: str) -> tuple[int, int]:
    """Returns the number of a split's tasks, and of each task's demonstrations.

    Validation tasks have at least one demonstration to spare, on which `listening.measure` asks for actions.
    """
    return {
        "train": (config.data.tasks, config.data.demos_per_task),
        "validation": (config.evaluation.validation_tasks, config.evaluation.shots + max(config.data.spare_demos, 1)),
        "test": (config.evaluation.tasks, config.evaluation.shots + config.data.spare_demos),
    }[split]


def demos_of_split(env: envs.Env, config: Config, split: str) -> DemoSet:
    """Returns the demonstrations of a split as a run uses them, planned or from the cache of earlier runs."""
    num_tasks, num_demos = size_of_split(config, split)
    seed = config.seed if split == "train" else EVALUATION_SEED
    folder = platform.cache_folder() / "demos"
    return demos_lib.cached(folder, env, seed, split, num_tasks, num_demos, config.data)


def trial_key(split: str) -> jax.Array:
    """Draws the trial scenes of a split."""
    return jax.random.fold_in(jax.random.key(EVALUATION_SEED), len(SPLITS) + SPLITS.index(split))


def large(name: str, env: envs.Env) -> envs.Env:
    """Makes the environment of that name with images large enough to look at, whole multiples of those of `env`."""
    height, width = env.image_shape
    scale = max(1, _LARGE // height)
    return envs.make(name, (scale * height, scale * width))


def training_on(env: envs.Env, config: Config, train: DemoSet) -> Training:
    """Makes a run's view of planned demonstrations.

    Args:
        env: the environment that they are of.
        config: of the run.
        train: the demonstrations for training.

    Returns:
        The demonstrations with their hash, their statistics and some first images.

    Raises:
        ValueError: if no task has enough successful demonstrations for support and query.
    """
    most, shots = int(train.success.sum(axis=1).max()), config.train.shots
    if most <= shots:
        raise ValueError(f"data: at most {most} demonstrations of a task succeed, expected more than {shots}")
    action = in_chunks(train.action, config.method.chunk)
    statistics = whitening.fit(_robot_states(env, train.states), action, config.method.whiten_actions)

    def first_images() -> list[np.ndarray]:
        task, states = jax.tree.map(lambda x: x[:128], (train.task, train.states))
        return [np.asarray(jax.jit(jax.vmap(env.render))(task, jax.tree.map(lambda x: x[:, 0, 0], states)))]

    return Training(pytrees.fingerprint(train), statistics, lambda _: train, first_images)


def validation_of(
    env: envs.Env, method: Method, params: Params, demos: DemoSet, config: EvalConfig
) -> tuple[float, dict[str, float]]:
    """Evaluates on the validation tasks.

    Args:
        env: the environment.
        method: what adapts and acts.
        params: what it has learned.
        demos: of the validation tasks.
        config: trials, shots and batch.

    Returns:
        The success rate in their trials, and what `listening.measure` finds there.
    """
    trials = closed_loop.run_trials(env, method, params, demos, config, trial_key("validation"))
    return float(trials.success.mean()), closed_loop.listen(env, method, params, demos, config)


def result_of(
    env: envs.Env, method: Method, params: Params, demos: DemoSet, config: Config, baselines: closed_loop.Baselines
) -> tuple[Trials, dict[str, Any]]:
    """Evaluates on the test tasks, after their own demonstrations and after another task's.

    Args:
        env: the environment.
        method: what adapts and acts.
        params: what it has learned.
        demos: of the test tasks.
        config: of the run.
        baselines: what stands beside the results.

    Returns:
        The trials after the tasks' own demonstrations, and what the result file says of them.
    """
    run = functools.partial(closed_loop.run_trials, env, method, params, demos, config.evaluation, trial_key("test"))
    trials, misled = run(), run(misled=True, first=config.evaluation.baseline_trials)
    return trials, closed_loop.summarize(env, config, demos.task, trials, misled, baselines)


@jax.jit
def _firsts(test: DemoSet, trials: Trials) -> tuple[Task, State, State]:
    """Returns the tasks that a video shows, the first demonstration of each and the first trial."""
    task, demo, trial = jax.tree.map(lambda x: x[:_FILMED], (test.task, test.states, trials.states))
    return task, *(jax.tree.map(lambda x: x[:, 0], states) for states in (demo, trial))


@functools.partial(jax.jit, static_argnums=0)
def _robot_states(env: envs.Env, states: State) -> jax.Array:
    return jax.vmap(jax.vmap(jax.vmap(env.robot_state)))(states)


class SimulatedRun(Run):
    """A run in the environment that `config.env_name` names.

    Args:
        config: what to run.
        workdir: the folder; made if missing.
        console: where to report progress.

    Raises:
        ValueError: as `Run`, and if no demonstration is left to be the query.
    """

    metric = "success"

    def __init__(self, config: Config, workdir: str | pathlib.Path, console: Console | None = None):
        check_config(config)
        if config.data.demos_per_task <= config.train.shots:
            expected = f"more than train.shots = {config.train.shots}: another one is the query"
            raise ValueError(f"data.demos_per_task: got {config.data.demos_per_task}, expected {expected}")
        self.env = envs.of_config(config)
        self._demonstrations: dict[str, dict[str, float]] = {}
        sample = demos_lib.sampler(self.env, config.train, config.method.chunk)
        super().__init__(config, self.env.spec, sample, workdir, console)

    def demos(self, split: str) -> DemoSet:
        """Returns the demonstrations of a split, planned or from the cache of earlier runs."""
        count = math.prod(size_of_split(self.config, split))
        with self.clock("demos"), self.phase(f"planning {split} demonstrations", count):
            demos = demos_of_split(self.env, self.config, split)
        success = float(demos.success.mean())
        self._demonstrations[split] = {"count": count, "success": success}
        self.console.print(f"{count} {split} demonstrations, of which {success:.1%} succeed")
        return demos

    def report(self, result: dict[str, Any]) -> None:
        """Prints success, interval, baselines and upper bound."""
        low, high = result["wilson95"]
        baselines = ", ".join(f"{name.replace('_', '-')} {value:.1%}" for name, value in result["baselines"].items())
        self.console.print(
            f"[bold]{result['success']:.1%}[/bold] of {result['trials']} trials on held-out tasks succeed "
            f"(95% interval {low:.1%} to {high:.1%}; {baselines}). {result['wall_clock_s']['total']:.0f} s in all. "
            f"See {self.folder}"
        )

    @property
    def _files(self) -> dict[str, str]:
        return super()._files | {
            f"{self.folder}/{VIDEO}": "demonstrations on the left, the policy's trials on the right"
        }

    @property
    def _next(self) -> dict[str, str]:
        other = next(name for name in ("push", "reach") if name != self.config.env_name)
        watch = {"darwin": "open", "win32": "start"}.get(sys.platform, "xdg-open")
        return {
            "look at the video": f"{watch} {self.folder}/{VIDEO}",
            **super()._next,
            "train another task": f"python -m milx.train --env={other}",
        }

    @functools.cached_property
    def _validation(self) -> DemoSet:
        return self.demos("validation")

    def _load(self) -> Training:
        train, _ = self.demos("train"), self._validation
        return training_on(self.env, self.config, train)

    def _shapes(self) -> DemoSet:
        return demos_lib.shapes(self.env, self.config.data.tasks, self.config.data.demos_per_task)

    @property
    def _compiles_alone(self) -> bool:
        return self.env.captures_graphs

    def _precompile(self, params: Params) -> list[Callable[[], None]]:
        env, config, random = self.env, self.config.evaluation, Random(self.env.action_size)
        fewer = min(config.baseline_trials, config.trials)
        return [
            lambda: closed_loop.precompile(env, self.method, params, config, sorted({config.trials, fewer})),
            lambda: closed_loop.precompile(env, random, {}, config, [fewer]),
            lambda: closed_loop.precompile_listen(env, self.method, params, config),
            lambda: closed_loop.precompile_film(self._large, min(config.tasks, _FILMED)),
        ]

    def _validate(self, params: Params) -> tuple[float, dict[str, float]]:
        return validation_of(self.env, self.method, params, self._validation, self.config.evaluation)

    def _judge(self, params: Params) -> tuple[dict[str, Any], Callable[[dict[str, Any]], None]]:
        config, test = self.config, self.demos("test")
        with self.clock("evaluate"):
            key, tasks = trial_key("test"), config.evaluation.tasks
            with self.phase("evaluating the baselines", (1 + 2 * config.evaluation.baseline_trials) * tasks):
                baselines = closed_loop.evaluate_baselines(self.env, test, config.evaluation, config.data, key)
            with self.phase("evaluating the policy", 2 * tasks):
                trials, found = result_of(self.env, self.method, params, test, config, baselines)

        def draw(result: dict[str, Any]) -> None:
            metrics = read_metrics(self.folder / "metrics.jsonl")
            plots.learning_curve(metrics, result, self.folder / "learning_curve.png")
            with self.phase("drawing the video"):
                self._film(test, trials)

        return found | {"demonstrations": self._demonstrations}, draw

    @functools.cached_property
    def _large(self) -> envs.Env:
        """The environment with images large enough to look at."""
        return large(self.config.env_name, self.env)

    def _film(self, test: DemoSet, trials: Trials) -> None:
        """Writes the video: demonstrations beside the first trial of the same held-out tasks, in large."""
        task, demo, trial = parallel.replicate(_firsts(test, trials))
        left, right = (np.asarray(closed_loop.film(self._large, task, states)) for states in (demo, trial))
        plots.side_by_side(left, right, self.folder / VIDEO)
