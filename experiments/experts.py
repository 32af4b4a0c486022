"""Who demonstrates push more reliably, its controller or iLQR started from it, without and with noise on the actions.

    python experiments/experts.py       # about five minutes on a GPU, half of it compilation

Training scenes, floors beside them. The controller answers to where the object is; a plan's feedback is linear around
one trajectory.
"""

import functools
import pathlib
import time
from typing import Any

import jax
from absl import app, flags

from milx import envs, provenance, results
from milx.envs.base import Env, State, Task
from milx.evaluator import wilson_interval
from milx.methods.random import Random
from milx.rollout import rollout
from milx.trajopt.expert import demonstrate, plan
from milx.trajopt.ilqr import Options

_OUT = flags.DEFINE_string("out", "experiments/results/experts/push.json", "The JSON file.")
_SCENES = flags.DEFINE_integer("scenes", 256, "Scenes, each of another task.", lower_bound=1)
_ITERATIONS = flags.DEFINE_integer("iterations", 5, "Most iterations of iLQR.", lower_bound=1)
NOISE = (0.0, 0.1)
"""Standard deviation on the actions; the presets' is the last."""


def run(env: Env, scenes: int, iterations: int) -> dict[str, Any]:
    """Success of every expert at every noise, by the paper's criterion, with counts, intervals and seconds."""
    task_keys, scene_keys, keys = (jax.random.split(key, scenes) for key in jax.random.split(jax.random.key(0), 3))
    tasks = jax.vmap(lambda key: env.sample_task(key, "train"))(task_keys)
    states = jax.vmap(env.reset)(scene_keys, tasks)
    began = time.perf_counter()
    options = Options(iterations=iterations)
    plans = jax.jit(jax.vmap(lambda task, state: plan(env, task, state, options)))(tasks, states)
    jax.block_until_ready(plans)
    planned_s = time.perf_counter() - began

    @functools.partial(jax.jit, static_argnames="planned")
    def succeeds(believed: Task, noise: float, planned: bool) -> jax.Array:
        def one(believed: Task, task: Task, state: State, expert: Any, key: jax.Array) -> jax.Array:
            visited, _ = demonstrate(env, believed, state, expert if planned else None, key, noise)
            return env.success(task, visited)

        return jax.vmap(one)(believed, tasks, states, plans, keys)

    def random(task: Task, state: State, key: jax.Array) -> jax.Array:
        return env.success(task, rollout(env, Random(env.action_size), (), task, state, key)[0])

    def rate(success: jax.Array) -> dict[str, Any]:
        count = int(success.sum())
        return {"successes": count, "success": count / scenes, "wilson95": wilson_interval(count, scenes)}

    found: dict[str, Any] = {"scenes": scenes, "iterations": iterations, "planning_and_compilation_s": planned_s}
    for noise in NOISE:
        found[f"controller, noise {noise}"] = rate(succeeds(tasks, noise, planned=False))
        found[f"iLQR, noise {noise}"] = rate(succeeds(tasks, noise, planned=True))
    found["task-blind controller"] = rate(succeeds(jax.vmap(env.task_blind)(keys, tasks), 0.0, planned=False))
    return found | {"random": rate(jax.jit(jax.vmap(random))(tasks, states, keys))}


def main(_: list[str]) -> None:
    """Runs, prints and writes."""
    found = run(envs.make("push", (16, 16)), _SCENES.value, _ITERATIONS.value)
    for name, value in found.items():
        print(f"{name}: {value['success']:.1%}" if isinstance(value, dict) else f"{name}: {value}", flush=True)
    path = pathlib.Path(_OUT.value)
    path.parent.mkdir(parents=True, exist_ok=True)
    results.write_json(path, found | provenance.describe())


if __name__ == "__main__":
    app.run(main)
