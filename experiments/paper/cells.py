"""Runs that make up a figure: one JSON file each, with demonstrations and compiled programs shared.

Cells that differ only in seed and number of training tasks share every program: their demonstrations are the first of
one larger set, repeated to its size, so that shapes stay the same.
"""

import concurrent.futures
import contextlib
import dataclasses
import hashlib
import itertools
import json
import pathlib
import shutil
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from push_controller import let_control

from milx import envs, methods
from milx.config import assemble
from milx.config.assemble import make_config
from milx.config.schema import Config
from milx.core import files, pytrees, signals
from milx.core.checkpoint import Checkpoints
from milx.data import simulated as demos_lib
from milx.data.experts import description
from milx.data.simulated import DemoSet
from milx.evaluation import closed_loop, listening, provenance, results
from milx.training import loop
from milx.training.metrics import MetricsWriter, read_metrics
from milx.training.simulated import demos_of_split, result_of, training_on, trial_key, validation_of
from milx.training.state import Training, check_steps, initial_state, restore_state, save_state
from milx.training.update import Trainer, TrainState, compile_in_background, make_optimizer
from milx.types import Params

METHODS = {
    "reach": ("mil", "contextual", "lstm"),
    "reach_state": ("mil", "contextual", "lstm", "lstm_attention"),
    "push": ("mil", "contextual", "lstm"),
    "place": ("mil", "contextual", "lstm"),
    "grasp": ("mil", "contextual", "lstm"),
}
"""What is compared in each environment."""

STEPS = {"reach": 12_000, "reach_state": 10_000, "push": 30_000, "place": 20_000, "grasp": 20_000}
"""Meta-updates of every method."""

LEARNING_RATES = {
    "reach": {"mil": 3e-3, "contextual": 3e-4, "lstm": 3e-4},
    "reach_state": {"mil": 3e-3, "contextual": 3e-3, "lstm": 3e-3, "lstm_attention": 3e-4},
    "push": {"mil": 3e-3, "contextual": 3e-4, "lstm": 3e-4},
    "place": {"mil": 3e-3, "contextual": 3e-4, "lstm": 3e-4},
    "grasp": {"mil": 3e-3, "contextual": 3e-4, "lstm": 3e-4},
}
"""Peaks of the cosine, as `tune.py` found them on validation tasks; those of place and grasp, and of MIL on push, are
reach's."""


def methods_of(env: str, chosen: list[str] | None) -> list[str]:
    """Selects the methods of an environment, or those of them that were chosen.

    Raises:
        ValueError: for a method that no environment compares; the message lists those that are.
    """
    compared = sorted(set(itertools.chain(*METHODS.values())))
    if unknown := sorted(set(chosen or ()) - set(compared)):
        raise ValueError(f"methods: got {unknown[0]!r}, expected some of {', '.join(compared)}")
    return [method for method in METHODS[env] if chosen is None or method in chosen]


def configure(env: str, method: str, preset: str, seed: int, steps: int | None) -> Config:
    """Configures a preset as methods are compared: own rates, `steps` or STEPS meta-updates, no redrawn scenes.

    A small set of demonstrations is to be small in colors and places, too. On vision reach eight time steps of the
    query and three layers learn faster than the three and two of `fast`, which end a little higher.
    """
    config = let_control(make_config(env, method, preset, seed))
    config.train.steps = steps or STEPS[env]
    config.train.eval_every = min(4000, config.train.steps)
    config.train.redraw = False
    if (method, preset) != ("mil", "paper"):  # which has its own
        config.optimizer.learning_rate = LEARNING_RATES[env][method]
    if env == "reach" and config.train.query_frames is not None:
        config.train.query_frames = 8
        config.network.fc_layers = config.network.fc_layers[:1] * 3
    return config


class Trained(NamedTuple):
    """What did best on validation tasks.

    Attributes:
        params: its parameters.
        step: after how many meta-updates.
        validation: its success there.
        seconds: what compiling the training ("compile"; 0 if an earlier cell did), training and validating took.
        curve: what every validation found, with the "step" and the training "loss".
    """

    params: Params
    step: int
    validation: float
    seconds: dict[str, float]
    curve: list[dict[str, Any]]


class Cells:
    """Runs cells, each a configuration with a name, and keeps what later ones can use again.

    A process that is killed leaves the checkpoint of its last validation in `unfinished/` beside the result files. The
    next one goes on from there if configuration, commit and versions are the same. The folder can be carried to another
    machine, which plans the same demonstrations up to rounding.

    Args:
        folder: where the result files are.
        capacity: tasks in the largest cell.
    """

    def __init__(self, folder: pathlib.Path, capacity: int):
        self.folder, self.capacity = folder, capacity
        self._made: dict[Any, Any] = {}
        self._unneeded: list[pathlib.Path] = []

    def is_done(self, name: str, config: Config) -> bool:
        """Tells whether the cell has its file.

        Raises:
            ValueError: if the file is another configuration's (the message shows the difference), or of another version
                of the environment; old files do not tell theirs.
        """
        path = self.folder / f"{name}.json"
        if not path.is_file():
            return False
        found, version = json.loads(path.read_text()), envs.find(config.env_name).version
        if (theirs := found.get("env_version", version)) != version:
            held = f"holds a cell of version {theirs} of {config.env_name}"
            raise ValueError(f"{path}: {held}, expected {version}; remove the file to train the cell again")
        before = assemble.from_dict(found["config"])
        if changed := assemble.differences(_contents(before), _contents(config)):
            raise ValueError(f"{path}: holds another cell: {'; '.join(changed)}")
        return True

    def run(self, named: dict[str, Config]) -> None:
        """Trains and evaluates those of the cells that are not done, and writes `name`.json of each.

        Cells that differ in their evaluation only are trained once and written together at the end. Times of
        demonstrations and baselines count for the cell that was the first to need them.
        """
        missing = {name: config for name, config in named.items() if not self.is_done(name, config)}
        for config in missing.values():
            self._check(config)
        finished = {name: self._run(name, config) for name, config in missing.items()}
        for name, result in finished.items():
            self.write(name, result)
            print(f"{name}: {result['success']:.1%}, {result['wall_clock_s']['total']:.0f} s", flush=True)
        self.forget()

    def _run(self, name: str, config: Config) -> dict[str, Any]:
        began = time.perf_counter()
        programs = self._compiling(config)  # while demonstrations are planned
        if self._env(config).captures_graphs:
            concurrent.futures.wait(programs)
        clock = [time.perf_counter()]
        env, method, evaluation = self._env(config), self._trainer(config).method, config.evaluation
        train, test = self._first_tasks(config), self._demos(config, "test")
        baselines = self._once(
            ("baselines", env, *description(env, config.data)),
            lambda: closed_loop.evaluate_baselines(env, test, evaluation, config.data, trial_key("test")),
        )
        clock.append(time.perf_counter())
        trained = self.train(name, config)
        clock.append(time.perf_counter())
        _, found = result_of(env, method, trained.params, test, config, baselines)
        clock.append(time.perf_counter())
        demos_s, _, evaluate_s = (later - earlier for earlier, later in itertools.pairwise(clock))
        seconds = {"demos": demos_s, **trained.seconds, "evaluate": trained.seconds["evaluate"] + evaluate_s}
        seconds["compile"] += clock[0] - began
        seconds["total"] = sum(seconds.values())
        digest = pytrees.fingerprint(train)
        result = results.compose(config, found, seconds, trained.step, digest)
        return result | {"validation_success": trained.validation, "curve": trained.curve}

    def write(self, name: str, result: dict[str, Any]) -> None:
        """Writes a cell's file."""
        self.folder.mkdir(parents=True, exist_ok=True)
        files.write_json(self.folder / f"{name}.json", result)

    def forget(self) -> None:
        """Deletes the checkpoints of the cells trained so far, once they have their files."""
        while self._unneeded:
            shutil.rmtree(self._unneeded.pop())

    def train(self, name: str, config: Config) -> Trained:
        """Meta-trains a cell; what differs in its evaluation only is not trained again.

        Raises:
            ValueError: if the number of tasks does not divide the capacity, the steps are not whole scans, another
                process trains this cell, or its last checkpoint could not be written.
        """
        self._check(config)
        return self._once(
            ("trained", self._programs(config), config.seed, config.data.tasks), lambda: self._train(name, config)
        )

    def _check(self, config: Config) -> None:
        if self.capacity % config.data.tasks:
            raise ValueError(f"data.tasks: got {config.data.tasks}, expected a divisor of {self.capacity}")
        check_steps(config)

    def _train(self, name: str, config: Config) -> Trained:
        times = self.capacity // config.data.tasks
        repeated = jax.tree.map(lambda x: jnp.concatenate([x] * times), self._first_tasks(config))
        identity = self._identity(config)
        training = training_on(self._env(config), config, repeated)._replace(dataset_hash=identity)
        folder = self.folder / "unfinished" / identity
        folder.mkdir(parents=True, exist_ok=True)
        with files.locked(folder / "lock"), contextlib.closing(Checkpoints(folder / "checkpoints")) as checkpoints:
            trained = self._fit(name, config, training, checkpoints)
        self._unneeded.append(folder)
        return trained

    def _identity(self, config: Config) -> str:
        """Names all on which a cell's parameters depend, but for rounding."""
        origin = provenance.origin()
        contents = json.dumps([_contents(config), self.capacity, origin["commit"], origin["versions"]])
        return hashlib.sha256(contents.encode()).hexdigest()[:16]

    def _fit(self, name: str, config: Config, training: Training, checkpoints: Checkpoints) -> Trained:
        env, trainer = self._env(config), self._trainer(config)
        evaluation = dataclasses.replace(config.evaluation, shots=config.train.shots)
        validation = self._demos(dataclasses.replace(config, evaluation=evaluation), "validation")
        state, key = initial_state(trainer, config, training)
        clock, stop, losses = loop.Clock(), signals.Stop(), dict[str, float]()
        if checkpoints.latest is not None:
            state, clock.seconds = restore_state(checkpoints, checkpoints.latest, state, training.dataset_hash)
            print(f"  {name}: goes on from step {int(state.step)}", flush=True)

        with clock("compile"):
            scan = self._compiling(config)[0].result()

        def validate(state: TrainState) -> float:
            step = int(state.step)
            success, heard = validation_of(env, trainer.method, state.params, validation, evaluation)
            metrics.write(step, losses | {"validation_success": success, **heard})
            said = "".join(f"loss {loss:.3f}, " for loss in losses.values())
            print(f"  {name} {step}: {said}validation {success:.1%}{listening.in_words(heard)}", flush=True)
            if warning := listening.warning(heard, step, config.train.steps, trainer.method):
                print(f"  {name}: {warning}", flush=True)
            return success

        hooks = loop.Hooks(
            log=lambda _, values: losses.update(loss=values["loss"]),
            validate=validate,
            save=lambda write, state, score: save_state(write, state, score, clock.elapsed(), training.dataset_hash),
        )
        metrics = MetricsWriter(checkpoints.folder.parent, int(state.step), print)
        with metrics, stop.listen():
            state = loop.fit(scan, state, key, training, config.train, checkpoints, hooks, clock, stop)
        if stop.asked:
            raise SystemExit(stop.exit_code)
        best = checkpoints.best
        assert best is not None
        params = checkpoints.restore(best, {"params": state.params})[0]["params"]
        curve = read_metrics(checkpoints.folder.parent / "metrics.jsonl")
        seconds = {name: clock.seconds[name] for name in ("compile", "train", "evaluate")}
        return Trained(params, best, checkpoints.score(best), seconds, curve)

    def _trainer(self, config: Config) -> Trainer:
        env = self._env(config)
        optimizer = make_optimizer(config.optimizer, config.train.steps)
        method = methods.make(config, env.spec)
        sample = demos_lib.sampler(env, config.train, config.method.chunk)
        make = lambda: Trainer(sample, method, config.train, optimizer)  # noqa: E731
        return self._once(("trainer", self._programs(config)), make)

    def _compiling(self, config: Config) -> list[Future[Any]]:
        """Compiles what trains and validates a cell, in the background, as `compile_in_background` returns it."""

        def start() -> list[Future[Any]]:
            env, trainer = self._env(config), self._trainer(config)
            params = methods.params_like(trainer.method, env.spec)
            validation = dataclasses.replace(config.evaluation, shots=config.train.shots)
            then = (
                lambda: closed_loop.precompile(env, trainer.method, params, validation, (validation.trials,)),
                lambda: closed_loop.precompile_listen(env, trainer.method, params, validation),
            )
            data = demos_lib.shapes(env, self.capacity, config.data.demos_per_task)
            return compile_in_background(trainer, params, data, config.train.log_every, then)

        return self._once(("compiled", self._programs(config)), start)

    def _env(self, config: Config) -> envs.Env:
        return self._once(("env", config.env_name, repr(config.env)), lambda: envs.of_config(config))

    def _programs(self, config: Config) -> str:
        """Describes all on which the compiled programs of training depend."""
        values = assemble.to_dict(config)
        del values["seed"], values["evaluation"], values["data"]["tasks"]
        return json.dumps(values)

    def _first_tasks(self, config: Config) -> DemoSet:
        return jax.tree.map(lambda x: x[: config.data.tasks], self._demos(config, "train"))

    def _demos(self, config: Config, split: str) -> DemoSet:
        """Returns validation or test tasks, or the training tasks of the largest cell with the same seed."""
        whole = dataclasses.replace(config, data=dataclasses.replace(config.data, tasks=self.capacity))
        env = self._env(config)
        which = config.seed if split == "train" else config.evaluation.shots
        key = "demos", env, split, which, *description(env, config.data)
        return self._once(key, lambda: demos_of_split(env, whole, split))

    def _once(self, key: Any, make: Callable[[], Any]) -> Any:
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]


def _contents(config: Config) -> dict[str, Any]:
    """Selects what makes a cell: how much runs at once does not."""
    values = assemble.to_dict(config)
    del values["evaluation"]["batch"], values["data"]["plan_batch"]
    return values


def read(folder: pathlib.Path) -> dict[str, dict[str, Any]]:
    """Reads all results of a folder, by the names of their cells."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}
