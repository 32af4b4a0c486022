"""Runs on recorded demonstrations: no simulator, so a policy is judged by the actions that it predicts.

Its score is how much closer its actions come, after adaptation, to those of a held-out task's other demonstrations than
the mean action of the training tasks does: 1 minus the ratio of the squared errors. With `evaluation.gym`, checkpoints
are chosen by the policy's success in a world instead.
"""

import dataclasses
import functools
import pathlib
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from milx import methods
from milx.config import assemble
from milx.config.check import check_config
from milx.config.schema import GIVEN, Config, ConvConfig
from milx.core import files
from milx.data import RECORDED
from milx.data.dataset import LARGEST, DataSet
from milx.data.goals import with_goals
from milx.data.recorded import MOST_DEMOS, Recorded, Shards, read_demos, read_later, sample_batch
from milx.deploy.policy import Policy, read_spec
from milx.evaluation import plots
from milx.evaluation.open_loop import task_errors
from milx.methods import whitening
from milx.methods.crop import middle
from milx.training.metrics import read_metrics
from milx.training.run import Run
from milx.training.state import Training
from milx.types import SPEC_FILE, Demo, Params, Spec, TaskBatch, by_field
from milx.worlds.client import Client, WorldError
from milx.worlds.evaluate import evaluate_in, tasks_of


def config_for(path: str | pathlib.Path, method: str = "mil", preset: str = "fast", seed: int = 0) -> Config:
    """Configures a preset for a data set: its image size, and no convolutions where there are no images.

    Raises:
        ValueError: for a path that holds no data set, or a preset that does not exist.
    """
    config, head = assemble.make_config(RECORDED, method, preset, seed), DataSet(path).header
    config.recorded.path = str(pathlib.Path(path).resolve())
    if isinstance(head.image_shape, tuple):
        config.env.image_shape = head.image_shape
    if head.image_shape is None and isinstance(config.network, ConvConfig):
        config.network.filters = config.network.strides = ()
        config.network.soft_argmax = config.network.mixed_precision = False
    return config


def spec_of(data: DataSet, config: Config) -> Spec:
    """Returns the sizes of what a policy sees and does on a data set."""
    head = data.header
    return Spec(
        head.image_shape,
        head.state_size,
        head.action_size,
        None,
        tuple(config.recorded.goal_indices),
        fps=head.fps,
        state_names=head.state_names,
        action_names=head.action_names,
        class_indices=head.class_indices,
    )


MIN_ERROR = 1e-9
"""An error of the mean action, in squared standard deviations, below which nothing is to be learned."""
MAX_RATIO = 1e6
"""The largest ratio of two errors: a score must stay above that of a checkpoint without one."""


class Statistics(NamedTuple):
    """States [F, S] of all time steps of some tasks, and actions [F', A] of those that show them."""

    state: np.ndarray
    action: np.ndarray


def read_vectors(data: DataSet, tasks: list[int], horizon: int, chunk: int = 1, history: int = 1) -> Statistics:
    """Reads all states and actions of these tasks, resampled to the horizon.

    Args:
        data: the data set.
        tasks: numbers of the tasks.
        horizon: time steps to which each demonstration is resampled.
        chunk: time steps whose actions stand side by side.
        history: time steps whose states do.

    Returns:
        The states of all demonstrations, and the actions of those that show them.

    Raises:
        ValueError: if a state or an action is not finite or beyond LARGEST; the message names the demonstration.
    """
    states, actions = [], []
    for task in tasks:
        info = data.header.tasks[task]
        for number in range(len(info.lengths)):
            demo = read_later(data, task, number, horizon, chunk, history, ("state",))()
            for field, value in (("state", demo.state), ("action", demo.action)):
                if value is not None and not (np.abs(value) <= LARGEST).all():
                    where = f"demonstration {number} of task {task} ({info.name!r})"
                    expected = f"finite ones of magnitude at most {LARGEST:.0e}"
                    raise ValueError(
                        f"data: {field} of {where}: got values that are not finite or too large, expected {expected}"
                    )
            states.append(np.zeros((horizon, 0), np.float32) if demo.state is None else demo.state)
            if demo.action is not None:
                actions.append(demo.action)
    return Statistics(np.concatenate(states), np.concatenate(actions))


class RecordedRun(Run):
    """A run on the data set `config.recorded.path`.

    Args:
        config: what to run.
        workdir: the folder; made if missing.
        console: where to report progress.

    Raises:
        ValueError: as `Run`; for a path that holds no data set; if no training task has enough demonstrations.
    """

    def __init__(self, config: Config, workdir: str | pathlib.Path, console: Console | None = None):
        check_config(config)
        self.metric = "success" if config.evaluation.gym else "score"
        if config.evaluation.gym and jax.process_count() > 1:
            raise ValueError(f"evaluation.gym: got {config.evaluation.gym}, expected None on several hosts")
        self.data = DataSet(config.recorded.path)
        settings, train = config.recorded, config.train
        if bad := [i for i in settings.goal_indices if i >= self.data.header.state_size]:
            raise ValueError(f"recorded.goal_indices: got {bad[0]}, expected less than {self.data.header.state_size}")
        self.given_action = config.method.given == GIVEN[0]
        for field, shots in (("train", train.shots), ("evaluation", config.evaluation.shots)):
            if shots >= MOST_DEMOS:
                raise ValueError(f"{field}.shots: got {shots}, expected less than {MOST_DEMOS}")
        for split in ("validation", "test"):
            if not any(self._enough(i, config.evaluation.shots) for i in self.data.header.of_split(split)):
                least = f"more than evaluation.shots = {config.evaluation.shots} demonstrations"
                raise ValueError(
                    f"data: {config.recorded.path} has no {split} task with {least}, expected at least one"
                )
        tasks = [i for i in self.data.header.of_split("train") if self._enough(i, train.shots)]
        if not tasks:
            of_actions = "that show actions" if self.given_action else "of which one shows actions"
            expected = f"at least one with more than train.shots = {train.shots} demonstrations {of_actions}"
            raise ValueError(f"data: {config.recorded.path} has no such training task, expected {expected}")
        self.shards = Shards(
            self.data,
            tasks,
            settings.horizon,
            settings.gib,
            config.seed,
            acting=train.shots + 1,
            chunk=config.method.chunk,
            history=settings.history,
        )

        def sample(recorded: Recorded, keys: jax.Array) -> TaskBatch:
            frames = train.support_frames, train.query_frames, train.frame_exponent
            changes = settings.shift, settings.recolor, settings.crop
            indices = tuple(settings.goal_indices)
            return sample_batch(recorded, keys, train.shots, *frames, self.given_action, indices, *changes)

        spec = spec_of(self.data, config)
        super().__init__(config, spec, sample, workdir, console)
        path = self.folder / SPEC_FILE
        if not path.is_file():
            files.write_json(path, spec.to_dict())
        elif (trained := read_spec(path)) != spec:
            raise ValueError(f"data: {config.recorded.path} has {spec}, expected {trained}, as when the run began")

    def _enough(self, task: int, shots: int) -> bool:
        return self.data.header.tasks[task].suffices(shots, self.given_action)

    @property
    def _sizes(self) -> tuple[int, int, int]:
        """The time steps of a demonstration, of a chunk, and of a history."""
        return self.config.recorded.horizon, self.config.method.chunk, self.config.recorded.history

    @functools.cached_property
    def _vectors(self) -> Statistics:
        return read_vectors(self.data, self.shards.tasks, *self._sizes)

    def _load(self) -> Training:
        if make := self.config.evaluation.gym:
            evaluation = self.config.evaluation  # says now if the world cannot be started
            Client(make, evaluation.gym_python or sys.executable, evaluation.gym_timeout).close()
        with self.clock("demos"), self.phase("reading demonstrations"):
            state, action = self._vectors
            vectors, classes = (jnp.asarray(state), jnp.asarray(action)), methods.classes(self.config, self.spec)
            statistics = whitening.fit(*vectors, self.config.method.whiten_actions, classes)
            dataset_hash = self.data.fingerprint()
            held_out = [i for split in ("validation", "test") for i in self.data.header.of_split(split)]
            read_vectors(self.data, held_out, *self._sizes)  # refuses what is not finite
        count = sum(len(self.data.header.tasks[i].lengths) for i in self.shards.tasks)
        self.console.print(f"{count} demonstrations of {len(self.shards.tasks)} training tasks")
        at = lambda step: self.shards.at(step // self.config.train.log_every)  # noqa: E731
        return Training(dataset_hash, statistics, at, self._first_images)

    def _first_images(self) -> list[np.ndarray]:
        first = [self.data.read(task, 0, np.zeros(1, int), fields=("image",)).image for task in self.shards.tasks[:128]]
        joined = jax.tree.map(lambda *images: np.concatenate(images), *first)
        return list(by_field(middle(joined, self.config.recorded.crop)).values())

    def _shapes(self) -> Recorded:
        return self.shards.shapes

    def _validate(self, params: Params) -> tuple[float | None, dict[str, float]]:
        errors = self._errors(params, "validation")
        names = {"own_demo": "after", "other_demo": "other_task", "no_demo": "before"}
        heard = {name: _relative(errors, key) for name, key in names.items() if key in errors}
        score = 1 - heard["own_demo"]
        if self.config.evaluation.gym is None:
            return score, heard
        return self._success(params, self.config.evaluation.gym), heard | {"score": score}

    def _success(self, params: Params, make: str) -> float | None:
        """Computes how often a policy is successful in the world of the validation tasks, at any time.

        Episodes that are lost are reported. Those lost before their first step say nothing of the policy; None if all
        are.
        """
        policy, evaluation = Policy(self.method, self.spec, params, self.config), self.config.evaluation
        try:
            outcomes = evaluate_in(
                policy,
                make,
                tasks_of(self.data, "validation", policy),
                controls=["own"],
                episodes=evaluation.trials,
                workers=evaluation.gym_workers,
                python=evaluation.gym_python or sys.executable,
                timeout=evaluation.gym_timeout,
            )
        except WorldError as error:
            self._warn(f"the validation in {make} failed: {error}")
            return None
        for loss in {outcome.lost for outcome in outcomes if outcome.lost}:
            self._warn(f"an episode was lost: {loss}")
        begun = [outcome.ever for outcome in outcomes if outcome.steps]
        return float(np.mean(begun)) if begun else None

    def _judge(self, params: Params) -> tuple[dict[str, Any], Callable[[dict[str, Any]], None]]:
        with self.clock("evaluate"), self.phase("evaluating the policy"):
            errors = self._errors(params, "test")
        training = self.shards.tasks
        found = {
            "num_tasks_train": len(training),
            "num_demos_train": sum(len(self.data.header.tasks[i].lengths) for i in training),
            "shots": self.config.evaluation.shots,
            "given": self.config.method.given,
            "score": 1 - _relative(errors, "after"),
            "criterion": "squared error of the actions of held-out tasks' other demonstrations, in standard deviations",
            "action_error": errors,
        }
        metrics = self.folder / "metrics.jsonl"
        draw = lambda result: plots.action_errors(  # noqa: E731
            read_metrics(metrics), result, self.folder / "learning_curve.png"
        )
        return found, draw

    @property
    def _next(self) -> dict[str, str]:
        return super()._next | {"export the policy": f"python -m milx.export {self.folder} exported"}

    def report(self, result: dict[str, Any]) -> None:
        """Prints the errors of the actions."""
        errors = result["action_error"]
        names = {"before": "before adaptation", "other_task": "adapted to another task", "mean_action": "mean action"}
        baselines = ", ".join(f"{label} {errors[name]:.3f}" for name, label in names.items() if name in errors)
        self.console.print(
            f"[bold]{errors['after']:.3f}[/bold] +- {errors['standard_error']:.3f} is the squared error of the actions "
            f"on {errors['tasks']} held-out tasks after adaptation ({baselines}). See {self.folder}"
        )

    def _errors(self, params: Params, split: str) -> dict[str, float]:
        """Computes mean squared errors over the tasks of a split, in standard deviations of the actions."""
        shots = self.config.evaluation.shots
        tasks = [i for i in self.data.header.of_split(split) if self._enough(i, shots)]
        action = self._vectors.action
        mean, scale = action.mean(axis=0), np.maximum(action.std(axis=0), whitening.MIN_STD)
        found, previous = [], None
        for task in tasks:
            recorded, support = self._task(task, shots)
            errors = task_errors(self.method, shots, params, recorded, support, previous, mean, scale)
            found.append({name: float(error) for name, error in errors.items()})
            previous = support
        names = set.union(*(set(errors) for errors in found))
        means = {name: float(np.mean([errors[name] for errors in found if name in errors])) for name in sorted(names)}
        after = np.array([errors["after"] for errors in found])
        return {
            **means,
            "standard_error": float(after.std(ddof=1) / len(after) ** 0.5) if len(after) > 1 else 0.0,
            "tasks": len(tasks),
        }

    def _task(self, task: int, shots: int) -> tuple[Recorded, Demo]:
        """Reads a task's queries [D, T, ...], and the first `shots` demonstrations that may be shown as the support."""
        info = self.data.header.tasks[task]
        # Those without actions first, where they will do: the others are to be asked.
        numbers = sorted(range(len(info.lengths)), key=lambda i: info.has_action[i] and not self.given_action)
        shown = [i for i in numbers if info.has_action[i] or not self.given_action][:shots]
        asked = [i for i in numbers if info.has_action[i] and i not in shown][: MOST_DEMOS - shots]
        recorded = jax.tree.map(lambda x: x[0], read_demos(self.data, [task], [[*shown, *asked]], *self._sizes))
        image = middle(recorded.demo.image, self.config.recorded.crop)
        recorded = dataclasses.replace(recorded, demo=dataclasses.replace(recorded.demo, image=image))
        support = jax.tree.map(lambda x: x[:shots], recorded.demo)
        fill = MOST_DEMOS - len(shown) - len(asked)
        rest = lambda x: np.pad(x[shots:], [(0, fill)] + [(0, 0)] * (x.ndim - 1))  # noqa: E731
        queries = Recorded(recorded.number, *jax.tree.map(rest, (recorded.demo, recorded.there, recorded.acts)))
        return queries, with_goals(support, tuple(self.config.recorded.goal_indices))


def _relative(errors: dict[str, float], name: str) -> float:
    """Divides an error by that of the mean action, which is zero if all actions of the held-out tasks are the same."""
    return min(errors[name] / max(errors["mean_action"], MIN_ERROR), MAX_RATIO)
