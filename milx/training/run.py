"""One run, from nothing to an evaluated policy, in one folder; started again, it continues where it stopped.

config.json             the configuration
checkpoints/            the latest and the best by validation
metrics.jsonl           one line for every log and validation; events.* hold the same for TensorBoard
evaluation.json         the result on held-out tasks
learning_curve.png

`milx.training.simulated` and `milx.training.recorded` say where demonstrations come from and how a policy is judged.
"""

import abc
import contextlib
import pathlib
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import numpy as np
import rich.markup
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from milx import methods
from milx.config import assemble
from milx.config.schema import Config
from milx.core import parallel, platform
from milx.core.checkpoint import UNVALIDATED, Checkpoints
from milx.evaluation import listening, results
from milx.methods import params_like
from milx.networks import fixed_filters
from milx.training import signals
from milx.training.metrics import MetricsWriter
from milx.training.state import Training, check_steps, initial_state, restore_state, save_state
from milx.training.update import Sample, Trainer, TrainState, make_optimizer
from milx.types import Params, Spec

MOST_IN_VAIN = 100
"""Updates in a row that are not finite, after which a run stops (at the end of the scan)."""


def _describe_skipped(values: dict[str, float], step: int) -> str:
    task = int(values["bad_task"])
    culprit = f"in task {task} of the training set" if task >= 0 else "in the gradient"
    return f"{values['skipped']:.0f} updates before step {step} were skipped: something was not finite, {culprit}"


class Run(abc.ABC):
    """A run's folder and method, and the loop of training and validation.

    Args:
        config: what to run.
        spec: the sizes of what the policy sees and does.
        sample: draws batches of the data of `Training.at`.
        chain: joints in the longest kinematic chain that training computes poses of.
        workdir: the folder; made if missing.
        console: where to report progress.

    Raises:
        ValueError: if the folder holds a run of another configuration (the message shows the difference), the steps are
            not whole numbers of scans, or the tasks of a meta-batch cannot be shared evenly by the devices.
    """

    metric: str
    """What `_validate` returns; the more the better."""

    def __init__(
        self,
        config: Config,
        spec: Spec,
        sample: Sample,
        chain: int,
        workdir: str | pathlib.Path,
        console: Console | None = None,
    ):
        self.config, self.spec, self._chain = config, spec, chain
        self.folder = pathlib.Path(workdir)
        self.console = console or Console(quiet=not parallel.is_first_host())
        self._checkpoints = self.folder / "checkpoints"
        if not parallel.is_first_host():  # its copies of the other files are the same, and not needed
            self.folder = pathlib.Path(tempfile.mkdtemp())
        check_steps(config)
        if config.train.meta_batch % parallel.num_devices():
            expected = f"a multiple of the {parallel.num_devices()} devices"
            raise ValueError(f"train.meta_batch: got {config.train.meta_batch}, expected {expected}")
        self.method = methods.make(config, spec)
        self.trainer = Trainer(sample, self.method, config.train, make_optimizer(config.optimizer, config.train.steps))
        self.seconds = {"demos": 0.0, "compile": 0.0, "train": 0.0, "evaluate": 0.0, "total": 0.0}
        self._began = time.perf_counter()
        self._claim_folder()

    @abc.abstractmethod
    def _load(self) -> Training:
        """What to train on."""

    @abc.abstractmethod
    def _shapes(self) -> Any:
        """Shapes and types of the data of `Training.at`."""

    @abc.abstractmethod
    def _validate(self, params: Params) -> tuple[float, dict[str, float]]:
        """How well the parameters do on validation tasks, and what `listening.measure` finds there."""

    @abc.abstractmethod
    def _judge(self, params: Params) -> tuple[dict[str, Any], Callable[[dict[str, Any]], None]]:
        """What the parameters reach on test tasks: fields of the result, and a function that draws the whole result."""

    @abc.abstractmethod
    def report(self, result: dict[str, Any]) -> None:
        """Prints a result of `evaluate`."""

    def _precompile(self, params: Params) -> list[Callable[[], None]]:
        """Other programs worth compiling in the background, from the shapes of the parameters."""
        del params
        return []

    def train(self) -> None:
        """Meta-trains to the configured number of steps, from the latest checkpoint if there is one.

        On SIGTERM it writes a checkpoint after the scan under way, which is not validated, and ends the process; during
        a validation, before which there is a checkpoint, it ends at once.

        Raises:
            ValueError: if another process trains in this folder, its checkpoints are all damaged, the last one could
                not be written, or MOST_IN_VAIN updates in a row were skipped because they were not finite.
            SystemExit: with code 0, after SIGTERM.
        """
        stop = signals.Stop()
        with signals.one_trainer(self.folder), stop.listen():
            self._claim_folder()  # another process may have written its own configuration before this one had the lock
            for leftover in self.folder.glob("*.partial*"):
                if leftover.is_file():
                    leftover.unlink()
            self._train(stop)

    def _train(self, stop: signals.Stop) -> None:
        config = self.config.train
        checkpoints = Checkpoints(self._checkpoints, report=self._warn)
        latest = checkpoints.latest
        if latest is not None and latest >= config.steps and checkpoints.score(latest) != UNVALIDATED:
            return checkpoints.close()
        if self.config.network.fixed_filters not in (None, fixed_filters.KMEANS):
            fixed_filters.load(
                self.config.network.fixed_filters, self.config.network
            )  # refuses a bad file before planning
        compiled = self._compile_in_background()
        training = self._load()
        state, key = self._start(training, checkpoints)
        with self._clock("compile"):
            run_steps = compiled.result()
        metrics, written, step = MetricsWriter(self.folder, int(state.step), self._warn), True, int(state.step)

        def save(state: TrainState, score: float, write: Callable[..., bool]) -> bool:
            return save_state(write, state, score, self._elapsed(), training.dataset_hash)

        def validate(state: TrainState) -> bool:
            """Gives a checkpoint its score; a signal meanwhile loses nothing but that."""
            with self._clock("evaluate"):
                score, heard = self._validate(state.params)
            values = {self.metric: score, **heard}
            metrics.write(int(state.step), {f"validation_{name}": value for name, value in values.items()})
            self.console.print(
                f"step {int(state.step)}: validation {self.metric} {score:.1%}{listening.describe(heard)}"
            )
            meta_updates = int(state.step) - self.method.imitation_steps
            if 5 * meta_updates >= config.steps - self.method.imitation_steps and listening.is_deaf(heard):
                self._warn(listening.advice(has_inner_step=self.config.method_name == "mil"))
            with stop.deferred():
                return save(state, score, checkpoints.replace)

        def is_due(step: int) -> bool:
            return step % config.eval_every == 0 or step >= config.steps

        if step and is_due(step) and checkpoints.score(step) == UNVALIDATED:  # there was no time for it
            written = validate(state)
        with self._progress(config.steps) as progress:
            bar = progress.add_task(
                "meta-train", total=config.steps, completed=int(state.step), loss=float("nan"), rate=0
            )
            stopping, in_vain = False, 0
            while step < config.steps and not stopping:
                with stop.deferred():
                    began = time.perf_counter()
                    with self._clock("train"):
                        state, values = run_steps(state, training.at(step), key)
                        values = {name: float(value) for name, value in values.items()}
                    rate = config.log_every / (time.perf_counter() - began)
                    step += config.log_every
                    metrics.write(step, {**values, "steps_per_s": rate})
                    progress.update(bar, completed=step, loss=values["loss"], rate=rate)
                    if values["skipped"]:
                        self._warn(_describe_skipped(values, step))
                    in_vain = in_vain + config.log_every if values["skipped"] == config.log_every else 0
                    if in_vain >= MOST_IN_VAIN:
                        last = "there is no checkpoint"
                        if checkpoints.latest is not None:
                            last = f"the last good checkpoint is of step {checkpoints.latest}"
                        raise ValueError(f"train: no update of the last {in_vain} was finite; {last}")
                    stopping = parallel.on_any_host(stop.asked)
                    if is_due(step) or stopping:
                        written = save(state, UNVALIDATED, checkpoints.save)
                if is_due(step):  # all there is has been saved
                    stopping = parallel.on_any_host(stop.asked)
                    if written and not stopping:
                        written = validate(state)
        metrics.close()
        latest = checkpoints.latest
        checkpoints.close()
        if not written:
            going_on = "started again, the run goes on from there"
            raise ValueError(f"checkpoints: the last one that could be written is of step {latest}; {going_on}")
        if stopping:
            print(f"milx: stopped at step {step}; the same command goes on from there", flush=True)
            raise SystemExit(0)

    def _warn(self, message: str) -> None:
        self.console.print(f"[yellow]milx: {rich.markup.escape(message)}[/yellow]")

    def evaluate(self) -> dict[str, Any]:
        """Evaluates the best checkpoint on the test tasks; writes and returns evaluation.json, and draws it.

        Raises:
            ValueError: if there is no checkpoint yet.
        """
        checkpoints = Checkpoints(self._checkpoints, read_only=True, report=self._warn)
        step = checkpoints.best
        if step is None or checkpoints.latest is None:
            raise ValueError(f"workdir: {self.folder} has no checkpoint yet; train first")
        items, _ = checkpoints.restore(step, {"params": self._params_like})
        _, extra = checkpoints.restore(checkpoints.latest, {})
        self.seconds = extra["seconds"]
        found, draw = self._judge(items["params"])
        result = results.describe(self.config, found, self._elapsed(), step, extra["dataset_hash"])
        results.write_json(self.folder / "evaluation.json", result)
        draw(result)
        return result

    @property
    def _params_like(self) -> Params:
        return params_like(self.method, self.spec)

    def _compile_in_background(self) -> Future[Callable[..., Any]]:
        """Compiles the scan of meta-updates, and more, from shapes alone, while demonstrations are planned or read."""
        params = self._params_like
        state = TrainState(
            jax.ShapeDtypeStruct((), np.int32), params, jax.eval_shape(self.trainer.optimizer.init, params)
        )
        data, steps = self._shapes(), self.config.train.log_every

        def compile_step() -> Callable[..., Any]:
            lowered = Trainer.run.lower(self.trainer, state, data, jax.random.key(0), steps)
            return lowered.compile(platform.pixel_options(self._chain))

        thread = ThreadPoolExecutor(max_workers=1)  # tracing holds Python's lock: more would slow the planner's down
        compiled = thread.submit(compile_step)
        for compile_more in self._precompile(params):
            thread.submit(compile_more)
        thread.shutdown(wait=False)
        return compiled

    def _start(self, training: Training, checkpoints: Checkpoints) -> tuple[TrainState, jax.Array]:
        """The state to train from, and the key of the batches."""
        state, batch_key = initial_state(self.trainer, self.config, training)
        if checkpoints.latest is not None:
            state, self.seconds = restore_state(checkpoints, checkpoints.latest, state, training.dataset_hash)
            self.console.print(f"continuing from step {int(state.step)}")
        return state, batch_key

    def _claim_folder(self) -> None:
        """Writes the configuration, or checks that the folder's is the same."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / "config.json"
        mine = assemble.to_dict(self.config)
        if path.is_file():
            theirs = assemble.to_dict(assemble.read(path))
            changed = assemble.differences(theirs, mine)
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
