"""One run, from nothing to an evaluated policy, in one folder; started again, it continues where it stopped.

config.json             the configuration
checkpoints/            the latest and the best by validation
metrics.jsonl           one line for every log and validation; events.* hold the same for TensorBoard
evaluation.json         the result on held-out tasks
learning_curve.png
wandb_id, wandb/        of Weights & Biases, if `train.wandb` asks for it

`milx.training.simulated` and `milx.training.recorded` say where demonstrations come from and how a policy is judged.
"""

import abc
import concurrent.futures
import contextlib
import functools
import pathlib
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import jax
import rich.markup
from rich.console import Console

from milx import methods
from milx.config import assemble
from milx.config.schema import Config, ConvConfig
from milx.core import files, parallel, progress, signals
from milx.core.checkpoint import UNVALIDATED, Checkpoints
from milx.core.messages import printable, say
from milx.data import RECORDED
from milx.evaluation import listening, results
from milx.methods import params_like
from milx.networks import fixed_filters
from milx.training import loop
from milx.training.metrics import MetricsWriter
from milx.training.start import check_source
from milx.training.state import Training, check_steps, initial_state, parse_extra, restore_state, save_state
from milx.training.tracking import Tracker
from milx.training.update import Sample, Trainer, TrainState, compile_in_background, make_optimizer
from milx.types import Params, Spec

_ANYWHERE = ("gym_python", "gym_workers", "gym_timeout")
"""Fields of `config.evaluation` that may change between two starts of a run: they say where, not what, to evaluate."""


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
        workdir: the folder; made if missing.
        console: where to report progress.

    Raises:
        ValueError: if the folder holds a run of another configuration (the message shows the difference), the steps are
            not whole numbers of scans, the tasks of a meta-batch cannot be shared evenly by the devices, or a run that
            begins cannot start from `train.init` (`start.check_source`).
    """

    metric: str
    """What `_validate` returns; the more the better."""

    def __init__(
        self,
        config: Config,
        spec: Spec,
        sample: Sample,
        workdir: str | pathlib.Path,
        console: Console | None = None,
    ):
        self.config, self.spec = config, spec
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
        self.clock = loop.Clock()
        if config.train.init is not None and not any(path.name.isdigit() for path in self._checkpoints.glob("*")):
            check_source(config.train.init, self._params_like, config)  # what it refuses leaves the folder free
        self._claim_folder()

    @abc.abstractmethod
    def _load(self) -> Training:
        """Loads what to train on."""

    @abc.abstractmethod
    def _shapes(self) -> Any:
        """Returns shapes and types of the data of `Training.at`."""

    @abc.abstractmethod
    def _validate(self, params: Params) -> tuple[float | None, dict[str, float]]:
        """Validates the parameters: their score on validation tasks, and what `listening.measure` finds there.

        The score is None if it could not be found out; `_validate` has reported why.
        """

    @abc.abstractmethod
    def _judge(self, params: Params) -> tuple[dict[str, Any], Callable[[dict[str, Any]], None]]:
        """Evaluates the parameters on test tasks: fields of the result, and a function that draws the whole result."""

    @abc.abstractmethod
    def report(self, result: dict[str, Any]) -> None:
        """Prints a result of `evaluate`."""

    @property
    def _compiles_alone(self) -> bool:
        """Whether nothing may run while programs are compiled in the background."""
        return False

    def _precompile(self, params: Params) -> list[Callable[[], None]]:
        """Lists other programs worth compiling in the background, from the shapes of the parameters."""
        del params
        return []

    def train(self) -> None:
        """Meta-trains to the configured number of steps, from the latest checkpoint if there is one.

        A run may be given more steps than it began with. The learning rate is then that of the longer schedule.

        On SIGTERM, SIGINT or SIGHUP it writes a checkpoint after the scan under way, which is not validated, and ends
        the process; during a validation, before which there is a checkpoint, it ends at once (see `signals.Stop`).

        Raises:
            ValueError: if another process trains in this folder, its checkpoints are all damaged, the last one could
                not be written, or `loop.MOST_IN_VAIN` updates in a row were skipped because they were not finite.
            SystemExit: after a signal, with 128 plus its number.
        """
        stop = signals.Stop("stopped; the same command goes on")
        with files.locked(self.folder / "lock"), stop.listen():
            self._claim_folder(extend=True)  # another process may have written its own configuration before
            self._train(stop)

    def _train(self, stop: signals.Stop) -> None:
        config, network = self.config.train, self.config.network
        with contextlib.closing(Checkpoints(self._checkpoints, report=self._warn)) as checkpoints:
            latest = checkpoints.latest
            if latest is not None and latest >= config.steps and checkpoints.score(latest) != UNVALIDATED:
                return
            if isinstance(network, ConvConfig) and network.fixed_filters not in (None, fixed_filters.KMEANS):
                fixed_filters.read_filters(network.fixed_filters, network)  # refuses a bad file before planning
            params = self._params_like
            others = self._precompile(params)
            compiled = compile_in_background(self.trainer, params, self._shapes(), config.log_every, others)
            if self._compiles_alone:
                with self.clock("compile"), self.phase("compiling all programs"):
                    concurrent.futures.wait(compiled)
            training = self._load()
            state, key = self._start(training, checkpoints)
            with self.clock("compile"), self.phase("compiling the training program"):
                scan = compiled[0].result()
            is_tracked = config.wandb is not None and parallel.is_first_host()
            track = functools.partial(Tracker, self.folder, self.config) if is_tracked else None
            metrics = MetricsWriter(self.folder, int(state.step), self._warn, track)
            with metrics, self.phase("meta-training", config.steps, int(state.step)):
                hooks = self._hooks(metrics, training.dataset_hash)
                state = loop.fit(scan, state, key, training, config, checkpoints, hooks, self.clock, stop)
        if parallel.on_any_host(bool(stop.asked)):
            say(f"stopped at step {int(state.step)}; the same command goes on from there")
            raise SystemExit(stop.exit_code)

    def phase(self, description: str, total: int | None = None, done: int = 0) -> AbstractContextManager[None]:
        """Shows a phase on the console, as `milx.core.progress.phase` does."""
        return progress.phase(self.console, description, total, done)

    def _hooks(self, metrics: MetricsWriter, dataset_hash: str) -> loop.Hooks:
        config = self.config.train

        def log(step: int, values: dict[str, float]) -> None:
            metrics.write(step, values)
            progress.advance(config.log_every, f"loss {values['loss']:.4f}")
            if values["skipped"]:
                self._warn(_describe_skipped(values, step))

        def validate(state: TrainState) -> float:
            with self.phase("validating"):
                step, (score, heard) = int(state.step), self._validate(state.params)
            values = heard if score is None else {self.metric: score, **heard}
            metrics.write(step, {f"validation_{name}": value for name, value in values.items()})
            found = "unknown" if score is None else f"{score:.1%}"
            self.console.print(f"step {step}: validation {self.metric} {found}{listening.in_words(heard)}")
            if warning := listening.warning(heard, step, config.steps, self.method):
                self._warn(warning)
            return UNVALIDATED if score is None else score

        def save(write: Callable[..., bool], state: TrainState, score: float) -> bool:
            return save_state(write, state, score, self.clock.elapsed(), dataset_hash)

        return loop.Hooks(log, validate, save)

    def _warn(self, message: str) -> None:
        self.console.print(f"[yellow]milx: {rich.markup.escape(printable(message))}[/yellow]")

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
        dataset_hash, self.clock.seconds = parse_extra(checkpoints, checkpoints.latest, extra)
        found, draw = self._judge(items["params"])
        result = results.compose(self.config, found, self.clock.elapsed(), step, dataset_hash)
        files.write_json(self.folder / "evaluation.json", result)
        draw(result)
        return result

    def suggest(self) -> None:
        """Prints which files the run has left, and the commands that one wants next."""
        for lines in (self._files, self._next):
            width = max(map(len, lines))
            for name, text in lines.items():
                self.console.print(f"  {name:{width}}  {text}", highlight=False, markup=False, soft_wrap=True)

    @property
    def _files(self) -> dict[str, str]:
        names = {
            "checkpoints/": "the latest checkpoint, and the best by validation",
            "evaluation.json": "this result",
            "learning_curve.png": "the training as a plot",
        }
        return {f"{self.folder}/{name}": text for name, text in names.items()}

    @property
    def _next(self) -> dict[str, str]:
        return {"load the policy": f"python -ic 'import milx; policy = milx.load(\"{self.folder}\")'"}

    @property
    def _params_like(self) -> Params:
        return params_like(self.method, self.spec)

    def _start(self, training: Training, checkpoints: Checkpoints) -> tuple[TrainState, jax.Array]:
        """Returns the state to train from, and the key of the batches."""
        state, batch_key = initial_state(self.trainer, self.config, training, fresh=checkpoints.latest is None)
        if checkpoints.latest is not None:
            state, self.clock.seconds = restore_state(checkpoints, checkpoints.latest, state, training.dataset_hash)
            self.console.print(f"continuing from step {int(state.step)}")
        return state, batch_key

    def _claim_folder(self, extend: bool = False) -> None:
        """Writes the configuration, or checks that the folder's is the same but for more updates, wandb and _ANYWHERE.

        Args:
            extend: whether to write these.
        """
        path = self.folder / "config.json"
        mine = assemble.to_dict(self.config)
        if not path.is_file():
            files.write_json(path, mine)
            return
        theirs = assemble.to_dict(assemble.read(path))
        before = assemble.flatten(theirs)
        if mine["train"]["steps"] > theirs["train"]["steps"]:
            theirs["train"]["steps"] = mine["train"]["steps"]
        theirs["evaluation"] |= {name: mine["evaluation"][name] for name in _ANYWHERE}
        theirs["train"]["wandb"] = mine["train"]["wandb"]
        if self.config.env_name == RECORDED:
            theirs |= {group: mine[group] for group in ("env", "data")}  # which nothing reads
        if changed := assemble.differences(theirs, mine):
            raise ValueError(f"workdir: {self.folder} holds another run: {'; '.join(changed)}")
        if extend and assemble.flatten(mine) != before:
            files.write_json(path, mine)
