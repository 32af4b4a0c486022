"""Runs that make up a figure: one JSON file each, with demonstrations and compiled programs shared.

Cells that differ only in seed and number of training tasks share every program: their demonstrations are the first of
one larger set, repeated to its size, so that shapes stay the same.
"""

import dataclasses
import itertools
import json
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from milx import config as config_lib
from milx import envs, evaluator, methods, results
from milx.config import Config
from milx.data import demos as demos_lib
from milx.data.demos import DemoSet
from milx.policy import spec_of
from milx.run import initial_state, split_demos, trial_key
from milx.trainer import Trainer, TrainState, make_optimizer
from milx.types import Params


class Cells:
    """Runs cells whose result files do not exist yet.

    Args:
        folder: where the files are.
        capacity: tasks in the largest cell.
    """

    def __init__(self, folder: pathlib.Path, capacity: int):
        self.folder, self.capacity = folder, capacity
        self._made: dict[Any, Any] = {}

    def run(self, name: str, config: Config) -> None:
        """Trains and evaluates a cell and writes `name`.json; returns at once if there is one.

        Raises:
            ValueError: if the number of tasks does not divide the capacity.
        """
        path = self.folder / f"{name}.json"
        if path.is_file():
            return
        if self.capacity % config.data.tasks:
            raise ValueError(f"data.tasks: got {config.data.tasks}, expected a divisor of {self.capacity}")
        began, laps = time.perf_counter(), [0.0]
        trainer, evaluation = self._trainer(config), config.evaluation
        train, test = self._demos(config, "train"), self._demos(config, "test")
        train = jax.tree.map(lambda x: x[: config.data.tasks], train)
        floors = self._once(
            ("floors", config.env_name),
            lambda: evaluator.baselines(trainer.env, test, evaluation, config.data, trial_key("test")),
        )
        laps.append(time.perf_counter() - began)
        same = self._key(config), config.seed, config.data.tasks
        params, step = self._once(("params", *same), lambda: self._train(name, config, trainer, train))
        laps.append(time.perf_counter() - began)
        trials = evaluator.run_trials(trainer.env, trainer.method, params, test, evaluation, trial_key("test"))
        summary = evaluator.summary(trials.success)
        laps.append(time.perf_counter() - began)
        demos, train_s, evaluate = (b - a for a, b in itertools.pairwise(laps))
        seconds = {"demos": demos, "compile": 0.0, "train": train_s, "evaluate": evaluate, "total": laps[-1]}
        digest = demos_lib.fingerprint(train)
        result = results.describe(config, trainer.env, summary, floors, seconds, step, digest)
        self.folder.mkdir(parents=True, exist_ok=True)
        results.write_json(path, result)
        print(f"{name}: {summary['success']:.1%} in {laps[-1]:.0f} s", flush=True)

    def _train(self, name: str, config: Config, trainer: Trainer, train: DemoSet) -> tuple[Params, int]:
        """Meta-trains; returns the parameters that did best on validation tasks, and their step."""
        state, key = initial_state(trainer, config, train)
        repeated = jax.tree.map(lambda x: jnp.concatenate([x] * (self.capacity // config.data.tasks)), train)
        validation, evaluation = self._demos(config, "validation"), config.evaluation
        best: tuple[float, TrainState] = (-1.0, state)
        while int(state.step) < config.train.steps:
            for _ in range(config.train.eval_every // config.train.log_every):
                state, metrics = trainer.run(state, repeated, key, config.train.log_every)
            trials = evaluator.run_trials(
                trainer.env, trainer.method, state.params, validation, evaluation, trial_key("validation")
            )
            success = float(trials.success.mean())
            print(
                f"  {name} {int(state.step)}: loss {float(metrics['loss']):.3f}, validation {success:.1%}", flush=True
            )
            best = max(best, (success, state), key=lambda pair: pair[0])
        return best[1].params, int(best[1].step)

    def _trainer(self, config: Config) -> Trainer:
        env = self._once(
            (config.env_name, config.env.image_shape), lambda: envs.make(config.env_name, config.env.image_shape)
        )
        optimizer = make_optimizer(config.optimizer, config.train.steps)
        make = lambda: Trainer(env, methods.make(config, spec_of(env)), config.train, optimizer)  # noqa: E731
        return self._once(("trainer", self._key(config)), make)

    def _key(self, config: Config) -> str:
        """All on which the training's programs depend."""
        values = config_lib.to_dict(config)
        del values["seed"], values["evaluation"], values["data"]["tasks"]
        return json.dumps(values)

    def _demos(self, config: Config, split: str) -> DemoSet:
        """Validation and test tasks, or the training tasks of the largest cell with the same seed."""
        whole = dataclasses.replace(config, data=dataclasses.replace(config.data, tasks=self.capacity))
        env = self._trainer(config).env
        what = config.seed if split == "train" else config.evaluation.shots
        return self._once((config.env_name, split, what), lambda: split_demos(env, whole, split))

    def _once(self, key: Any, make: Callable[[], Any]) -> Any:
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]


def read(folder: pathlib.Path) -> dict[str, dict[str, Any]]:
    """All results of a folder, by the names of their cells."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}
