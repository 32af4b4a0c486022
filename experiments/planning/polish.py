"""Does iLQR polish a sampled plan? Cost and success after a search, after more of it, and after iLQR instead.

    python experiments/planning/polish.py                          # 256 scenes an environment, on a GPU
    python experiments/planning/polish.py --envs=place --scenes=24   # on two cores

Plans of whole episodes are searched for from nothing, by the settings of demonstrations (`planner.Settings`), in the
controls of `Env.steering` and in the approximate dynamics. Success is that of the plan in these dynamics, without
noise. Seconds are those of the compiled program for all scenes at once. iLQR moves every action, not a spline's knots.
"""

import dataclasses
import functools
import pathlib
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags

import milx
from milx import envs
from milx.core import files
from milx.envs.base import Env, State, Task
from milx.evaluation import provenance
from milx.trajopt import ilqr, sampling
from milx.trajopt.episode import approximated, steered
from milx.trajopt.planner import Planner, Settings

ITERATIONS = (2, 8)
"""Of iLQR."""
MORE = 24
"""More iterations of the search, as many as before."""
SEED = 2000
"""Of the scenes, which no other script draws."""


def judged(env: Env, task: Task, start: State, actions: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rolls out controls [T, k]: their cost, and whether they succeed."""
    problem = approximated(steered(env, task, start))

    def step(x: jax.Array, inputs: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        u, t = inputs
        r = problem.running_residual(x, u, t)
        return problem.dynamics(x, u), (x, 0.5 * r @ r)

    last, (states, costs) = jax.lax.scan(step, start.vector, (actions, jnp.arange(env.horizon)))
    r = problem.terminal_residual(last)
    visited = jax.vmap(start.with_vector)(jnp.concatenate([states, last[None]]))
    return costs.sum() + 0.5 * r @ r, env.success(task, visited)


def searched(env: Env, settings: Settings, iterations: int, task: Task, start: State, key: jax.Array) -> jax.Array:
    """Searches from nothing, and returns the controls [T, k]."""
    planner = Planner(env, settings)
    search = planner.improve(task, start, planner.begin(), key, iterations)
    return sampling.actions_of(planner.problem(task, start), search.knots, env.horizon, settings.search)


def polished(env: Env, iterations: int, task: Task, start: State, actions: jax.Array) -> jax.Array:
    """Improves controls [T, k] by iLQR, and returns those of the plan."""
    options = ilqr.Options(iterations=iterations)
    return ilqr.solve(approximated(steered(env, task, start)), start.vector, actions, options).actions


def timed(function: Callable[..., jax.Array], *args: Any) -> tuple[jax.Array, float]:
    """Returns what a function returns for all scenes at once, and its seconds without compilation."""
    compiled = jax.jit(jax.vmap(function)).lower(*args).compile()
    began = time.perf_counter()
    return jax.block_until_ready(compiled(*args)), time.perf_counter() - began


def measure(env: Env, scenes: int) -> dict[str, dict[str, float]]:
    """Measures each way to plan, by name."""

    def draw(key: jax.Array) -> tuple[Task, State, jax.Array]:
        task_key, scene_key, key = jax.random.split(key, 3)
        task = env.sample_task(task_key, "train")
        return task, env.reset(scene_key, task), key

    settings, found = Settings(), {}
    task, start, key = jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(SEED), scenes))
    judge = jax.jit(jax.vmap(functools.partial(judged, env)))

    def add(name: str, actions: jax.Array, seconds: float) -> None:
        cost, success = judge(task, start, actions)
        found[name] = {"median_cost": float(np.median(cost)), "success": float(np.mean(success)), "seconds": seconds}
        print(f"{env.name}: {name}: {found[name]}", flush=True)

    search = functools.partial(searched, env, settings)
    first, seconds = timed(functools.partial(search, settings.from_nothing), task, start, key)
    add(f"search, {settings.from_nothing} iterations", first, seconds)
    more, longer = timed(functools.partial(search, settings.from_nothing + MORE), task, start, key)
    add(f"search, {settings.from_nothing + MORE} iterations", more, longer)
    for iterations in ITERATIONS:
        better, added = timed(functools.partial(polished, env, iterations), task, start, first)
        add(f"search, {settings.from_nothing} iterations, and iLQR, {iterations}", better, seconds + added)
    return found


def main(_: list[str]) -> None:
    """Measures, and writes the file."""
    milx.configure()
    results, origin = {}, provenance.origin()  # before the file of another commit is replaced
    for name in _ENVS.value:
        results[name] = measure(envs.make(name, (16, 16)), _SCENES.value)
        said = {
            "scenes": _SCENES.value,
            "first_seed": SEED,
            "settings": dataclasses.asdict(Settings()),
            "ilqr": dataclasses.asdict(ilqr.Options()),
        }
        path = pathlib.Path(_OUT.value) / "polish.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        files.write_json(path, {**said, "results": results, **origin})


if __name__ == "__main__":
    _ENVS = flags.DEFINE_multi_enum("envs", ["reach", "place", "push"], list(envs.ENVS), "Which (repeat the flag).")
    _SCENES = flags.DEFINE_integer("scenes", 256, "Scenes, each of another task.", lower_bound=1)
    _OUT = flags.DEFINE_string("out", "experiments/results/planning", "Folder of the JSON file.")
    app.run(main)
