"""Who demonstrates push more reliably: its controller, with and without a choice of tactics, or iLQR started from it.

    python experiments/experts.py                   # on a GPU: iLQR takes long to compile
    python experiments/experts.py --iterations=0    # the controller alone

Training and validation scenes, without and with noise on the actions. A plan's feedback is linear around one
trajectory; the controller answers to where the object is.
"""

import functools
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax
from absl import app, flags

from milx import envs, provenance, results
from milx.evaluator import wilson_interval
from milx.trajopt.expert import judge, perform
from milx.trajopt.ilqr import Options

_OUT = flags.DEFINE_string("out", "experiments/results/experts/push.json", "The JSON file.")
_SCENES = flags.DEFINE_integer("scenes", 512, "Scenes of each split, each of another task.", lower_bound=1)
_ITERATIONS = flags.DEFINE_integer("iterations", 5, "Most iterations of iLQR; 0 for no iLQR.", lower_bound=0)
NOISE = (0.0, 0.1)
"""Standard deviation on the actions; the presets' is the last."""


def experts(iterations: int) -> dict[str, Callable[..., Any]]:
    """Functions of tasks, scenes, keys and noise, by name."""
    env, plain = (envs.make("push", (16, 16)) for _ in range(2))
    plain.tactics = plain.tactics[:1]
    found = {
        "controller": functools.partial(_success, env, Options(iterations=0)),
        "controller, one tactic": functools.partial(_success, plain, Options(iterations=0)),
    }
    return found | ({"iLQR": functools.partial(_success, plain, Options(iterations=iterations))} if iterations else {})


def _success(env: envs.Env, options: Options, split: str, scenes: int, noise: float, blind: bool = False) -> jax.Array:
    task_keys, scene_keys, keys = (jax.random.split(key, scenes) for key in jax.random.split(jax.random.key(0), 3))
    tasks = jax.vmap(lambda key: env.sample_task(key, split))(task_keys)
    states = jax.vmap(env.reset)(scene_keys, tasks)
    believed = jax.vmap(env.task_blind)(keys, tasks) if blind else tasks
    visited, _ = perform(env, believed, states, keys, options, noise)
    return judge(env, tasks, visited)[0]


def main(_: list[str]) -> None:
    """Runs, prints and writes."""
    found: list[dict[str, Any]] = []
    for name, success in experts(_ITERATIONS.value).items():
        for split in ("train", "validation"):
            runs = {f"noise {noise}": (noise, False) for noise in NOISE}
            runs |= {"task-blind": (0.0, True)} if name == "controller" else {}
            for how, (noise, blind) in runs.items():
                began = time.perf_counter()
                count = int(success(split, _SCENES.value, noise, blind).sum())
                row = {"expert": name, "split": split, "how": how, "seconds": time.perf_counter() - began}
                rate = {"success": count / _SCENES.value, "wilson95": wilson_interval(count, _SCENES.value)}
                found.append(row | rate)
                print(f"{name}, {split}, {how}: {rate['success']:.1%}, {row['seconds']:.0f} s", flush=True)
    contents = {"scenes": _SCENES.value, "iterations": _ITERATIONS.value, "experts": found}
    path = pathlib.Path(_OUT.value)
    path.parent.mkdir(parents=True, exist_ok=True)
    results.write_json(path, contents | provenance.describe())


if __name__ == "__main__":
    app.run(main)
