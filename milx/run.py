"""One run, from nothing to an evaluated policy, in one folder; started again, it continues where it stopped.

config.json             the configuration
checkpoints/            the latest and the best by validation success
metrics.jsonl           one line for every log and validation; events.* hold the same for TensorBoard
evaluation.json         success on held-out tasks, with floors and ceiling
learning_curve.png, rollouts.gif
"""

import contextlib
import dataclasses
import functools
import json
import pathlib
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from milx import config as config_lib
from milx import envs, evaluator, methods, parallel, platform, report, results, whitening
from milx.checkpoint import Checkpoints
from milx.config import Config
from milx.data import demos as demos_lib
from milx.data.demos import DemoSet
from milx.envs.base import State
from milx.methods.random import Random
from milx.metrics import MetricsWriter
from milx.networks import fixed
from milx.policy import params_like, spec_of
from milx.trainer import Trainer, TrainState, make_optimizer
from milx.types import Params

EVALUATION_SEED = 2017
"""Validation and test tasks and their trials are the same for every seed of a run."""


def split_demos(env: envs.Env, config: Config, split: str) -> DemoSet:
    """The demonstrations of a split as a run uses them, planned or from the cache of earlier runs."""
    num_tasks, num_demos = {
        "train": (config.data.tasks, config.data.demos_per_task),
        "validation": (config.evaluation.validation_tasks, config.evaluation.shots + config.data.spare_demos),
        "test": (config.evaluation.tasks, config.evaluation.shots + config.data.spare_demos),
    }[split]
    seed = config.seed if split == "train" else EVALUATION_SEED
    folder = platform.cache_folder() / "demos"
    return demos_lib.cached(folder, env, seed, split, num_tasks, num_demos, config.data)


def trial_key(split: str) -> jax.Array:
    """Draws the trial scenes of a split."""
    return jax.random.fold_in(jax.random.key(EVALUATION_SEED), len(envs.SPLITS) + envs.SPLITS.index(split))


def check_steps(config: Config) -> None:
    """Raises ValueError unless training and validation come after whole numbers of scans."""
    for name in ("steps", "eval_every"):
        value, scan = getattr(config.train, name), config.train.log_every
        if value < 1 or value % scan:
            raise ValueError(f"train.{name}: got {value}, expected a positive multiple of train.log_every = {scan}")


def initial_state(trainer: Trainer, config: Config, train: DemoSet) -> tuple[TrainState, jax.Array]:
    """The state before the first meta-update on these demonstrations, and the key of the batches.

    Raises:
        ValueError: if no task has enough successful demonstrations for support and query.
    """
    most, shots = int(train.success.sum(axis=1).max()), config.train.shots
    if most <= shots:
        raise ValueError(f"data: at most {most} demonstrations of a task succeed, expected more than {shots}")
    init_key, batch_key = jax.random.split(jax.random.fold_in(jax.random.key(config.seed), 3))
    statistics = whitening.fit(_robot_states(trainer.env, train.states), train.action, config.mil.whiten_actions)
    state = trainer.init(init_key, statistics)
    if config.network.fixed_filters is None or not trainer.env.vision:
        return state, batch_key
    if config.network.fixed_filters == fixed.KMEANS:
        filters = fixed.cluster(_first_images(trainer.env, train), config.network)
    else:
        filters = fixed.load(config.network.fixed_filters, config.network)
    return dataclasses.replace(state, params=fixed.put(state.params, filters)), batch_key


def _first_images(env: envs.Env, train: DemoSet) -> np.ndarray:
    """[N, H, W, 3] what a demonstration of each of the first 128 tasks shows first."""
    task, states = jax.tree.map(lambda x: x[:128], (train.task, train.states))
    return np.asarray(jax.jit(jax.vmap(env.render))(task, jax.tree.map(lambda x: x[:, 0, 0], states)))


@functools.partial(jax.jit, static_argnums=0)
def _robot_states(env: envs.Env, states: State) -> jax.Array:
    return jax.vmap(jax.vmap(jax.vmap(env.robot_state)))(states)


class Run:
    """A run's folder, environment and method.

    Args:
        config: what to run.
        workdir: the folder; made if missing.
        console: where to report progress.

    Raises:
        ValueError: if the folder holds a run of another configuration (the message shows the difference), no
            demonstration is left to be the query, the steps are not whole numbers of scans, or the tasks of a
            meta-batch cannot be shared evenly by the devices.
    """

    def __init__(self, config: Config, workdir: str | pathlib.Path, console: Console | None = None):
        self.config = config
        self.folder = pathlib.Path(workdir)
        self.console = console or Console(quiet=not parallel.is_first_host())
        self._checkpoints = self.folder / "checkpoints"
        if not parallel.is_first_host():  # its copies of the other files are the same, and not needed
            self.folder = pathlib.Path(tempfile.mkdtemp())
        if config.data.demos_per_task <= config.train.shots:
            expected = f"more than train.shots = {config.train.shots}: another one is the query"
            raise ValueError(f"data.demos_per_task: got {config.data.demos_per_task}, expected {expected}")
        check_steps(config)
        if config.train.meta_batch % parallel.num_devices():
            expected = f"a multiple of the {parallel.num_devices()} devices"
            raise ValueError(f"train.meta_batch: got {config.train.meta_batch}, expected {expected}")
        self.env = envs.make(config.env_name, config.env.image_shape)
        self.method = methods.make(config, spec_of(self.env))
        self.trainer = Trainer(
            self.env, self.method, config.train, make_optimizer(config.optimizer, config.train.steps)
        )
        self.seconds = {"demos": 0.0, "compile": 0.0, "train": 0.0, "evaluate": 0.0, "total": 0.0}
        self._began = time.perf_counter()
        self._claim_folder()

    def train(self) -> None:
        """Meta-trains to the configured number of steps, from the latest checkpoint if there is one."""
        config = self.config.train
        checkpoints = Checkpoints(self._checkpoints)
        if (checkpoints.latest or 0) >= config.steps:
            return checkpoints.close()
        compiled = self._compile_in_background()
        train, validation = self.demos("train"), self.demos("validation")
        dataset_hash = demos_lib.fingerprint(train)
        state, key = self._start(train, dataset_hash, checkpoints)
        with self._clock("compile"):
            run_steps = compiled.result()
        metrics = MetricsWriter(self.folder, int(state.step))
        with self._progress(config.steps) as progress:
            bar = progress.add_task(
                "meta-train", total=config.steps, completed=int(state.step), loss=float("nan"), rate=0
            )
            while (step := int(state.step)) < config.steps:
                began = time.perf_counter()
                with self._clock("train"):
                    state, values = run_steps(state, train, key)
                    values = {name: float(value) for name, value in values.items()}
                rate = config.log_every / (time.perf_counter() - began)
                step += config.log_every
                metrics.write(step, {**values, "steps_per_s": rate})
                progress.update(bar, completed=step, loss=values["loss"], rate=rate)
                if step % config.eval_every == 0 or step >= config.steps:
                    success = self._validate(state.params, validation)
                    metrics.write(step, {"validation_success": success})
                    progress.console.print(f"step {step}: validation success {success:.1%}")
                    items = {"params": state.params, "trainer": (state.step, state.optimizer)}
                    checkpoints.save(step, items, success, {"seconds": self._elapsed(), "dataset_hash": dataset_hash})
        metrics.close()
        checkpoints.close()

    def evaluate(self) -> dict[str, Any]:
        """Evaluates the best checkpoint on the test tasks; writes and returns evaluation.json, with plot and video.

        Raises:
            ValueError: if there is no checkpoint yet.
        """
        checkpoints = Checkpoints(self._checkpoints, read_only=True)
        step = checkpoints.best
        if step is None or checkpoints.latest is None:
            raise ValueError(f"workdir: {self.folder} has no checkpoint yet; train first")
        items, _ = checkpoints.restore(step, {"params": self._params_like})
        _, extra = checkpoints.restore(checkpoints.latest, {})
        self.seconds = extra["seconds"]
        config, test = self.config.evaluation, self.demos("test")
        key = trial_key("test")
        with self._clock("evaluate"):
            trials = evaluator.run_trials(self.env, self.method, items["params"], test, config, key)
            floors = evaluator.baselines(self.env, test, config, self.config.data, key)
        result = results.describe(
            self.config,
            self.env,
            evaluator.summary(trials),
            floors,
            self._elapsed(),
            step,
            extra["dataset_hash"],
        )
        results.write_json(self.folder / "evaluation.json", result)
        report.learning_curve(
            report.read_metrics(self.folder / "metrics.jsonl"), result, self.folder / "learning_curve.png"
        )
        self._film(test, trials.states)
        return result

    def report(self, result: dict[str, Any]) -> None:
        """Prints a result of `evaluate`."""
        low, high = result["wilson95"]
        floors = ", ".join(f"{name.replace('_', '-')} {value:.1%}" for name, value in result["baselines"].items())
        self.console.print(
            f"[bold]{result['success']:.1%}[/bold] of {result['trials']} trials on held-out tasks succeed "
            f"(95% interval {low:.1%} to {high:.1%}; {floors}). {result['wall_clock_s']['total']:.0f} s in all. "
            f"See {self.folder}"
        )

    def demos(self, split: str) -> DemoSet:
        """The demonstrations of a split, planned or from the cache of earlier runs."""
        with self._clock("demos"), self.console.status(f"planning {split} demonstrations"):
            demos = split_demos(self.env, self.config, split)
        count, success = demos.success.size, float(demos.success.mean())
        self.console.print(f"{count} {split} demonstrations, of which {success:.1%} succeed")
        return demos

    @property
    def _params_like(self) -> Params:
        return params_like(self.method, spec_of(self.env))

    def _compile_in_background(self) -> Future[Callable[..., Any]]:
        """Compiles the scan of meta-updates and the evaluation from shapes alone, while demonstrations are planned."""
        config, params = self.config, self._params_like
        state = TrainState(
            jax.ShapeDtypeStruct((), np.int32), params, jax.eval_shape(self.trainer.optimizer.init, params)
        )
        demos = demos_lib.shapes(self.env, config.data.tasks, config.data.demos_per_task)

        def compile_step() -> Callable[..., Any]:
            lowered = Trainer.run.lower(self.trainer, state, demos, jax.random.key(0), config.train.log_every)
            return lowered.compile(platform.pixel_options(self.env.chain))

        thread = ThreadPoolExecutor(max_workers=1)  # tracing holds Python's lock: more would slow the planner's down
        compiled = thread.submit(compile_step)
        for method, like in ((self.method, params), (Random(self.env.action_size), ())):
            thread.submit(evaluator.precompile, self.env, method, like, config.evaluation)
        thread.shutdown(wait=False)
        return compiled

    def _start(self, train: DemoSet, dataset_hash: str, checkpoints: Checkpoints) -> tuple[TrainState, jax.Array]:
        """The state to train from, and the key of the batches."""
        state, batch_key = initial_state(self.trainer, self.config, train)
        if checkpoints.latest is not None:
            like = {"params": state.params, "trainer": (state.step, state.optimizer)}
            items, extra = checkpoints.restore(checkpoints.latest, like)
            if extra["dataset_hash"] != dataset_hash:
                old, new = extra["dataset_hash"][:12], dataset_hash[:12]
                raise ValueError(
                    f"workdir: {self.folder} was trained on demonstrations {old}, but this device and these versions "
                    f"plan {new}; expected the device and versions that began the run, or another folder"
                )
            self.seconds = extra["seconds"]
            step, optimizer = items["trainer"]
            state = TrainState(step, items["params"], optimizer)
            self.console.print(f"continuing from step {int(step)}")
        return state, batch_key

    def _validate(self, params: Params, validation: DemoSet) -> float:
        key = trial_key("validation")
        with self._clock("evaluate"):
            trials = evaluator.run_trials(self.env, self.method, params, validation, self.config.evaluation, key)
            return float(trials.success.mean())

    def _film(self, test: DemoSet, visited: State, num_tasks: int = 3) -> None:
        """Writes the video: demonstrations beside the first trial of the same held-out tasks, in large."""
        height, width = self.env.image_shape
        scale = max(1, 256 // height)
        camera = envs.make(self.config.env_name, (scale * height, scale * width))
        task, demo, trial = jax.tree.map(lambda x: x[:num_tasks], (test.task, test.states, visited))
        clips = [evaluator.film(camera, task, jax.tree.map(lambda x: x[:, 0], states)) for states in (demo, trial)]
        report.side_by_side(np.asarray(clips[0]), np.asarray(clips[1]), self.folder / "rollouts.gif")

    def _claim_folder(self) -> None:
        """Writes the configuration, or checks that the folder's is the same."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / "config.json"
        mine = config_lib.to_dict(self.config)
        if path.is_file():
            theirs = config_lib.to_dict(config_lib.from_dict(json.loads(path.read_text())))
            changed = config_lib.differences(theirs, mine)
            if changed:
                raise ValueError(f"workdir: {self.folder} holds another run: {'; '.join(changed)}")
        else:
            results.write_json(path, mine)

    @contextlib.contextmanager
    def _clock(self, name: str) -> Iterator[None]:
        """Adds the time spent to `seconds[name]`."""
        began = time.perf_counter()
        yield
        self.seconds[name] += time.perf_counter() - began

    def _elapsed(self) -> dict[str, float]:
        """Seconds spent by this run so far, earlier sessions included."""
        now = time.perf_counter()
        self.seconds["total"] += now - self._began
        self._began = now
        return dict(self.seconds)

    def _progress(self, steps: int) -> Progress:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("loss {task.fields[loss]:.4f}  {task.fields[rate]:.1f} steps/s"),
            TimeRemainingColumn(),
        )
        return Progress(*columns, console=self.console)
