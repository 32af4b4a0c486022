"""Many demonstrations of push by sampling alone: how many succeed under noise, and how long they take to plan.

    python experiments/planning/demonstrate.py                     # 9,200 scenes on a GPU
    python experiments/planning/demonstrate.py --scenes=4 --batch=4 --plans=2

A first batch of scenes is searched from nothing, to have plans to begin with, and does not count. Each later batch
begins with the cheapest of the plans of its nearest scenes, is improved, and is executed under the presets' noise,
tracking the plan and planning what is left of it again every few time steps. The plans of executions that succeeded
join the others, as they were before their execution. Candidates are rolled out in the cheap model; what is executed
happens in the environment. No setting was chosen by these scenes.
"""

import pathlib
import time
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from absl import app, flags
from planner import DEVIATION, KNOTS, NEAR, TRACKING, Planner, draw, make_cheap_env, make_env, nearest

import milx
from milx.core import files
from milx.envs.base import State
from milx.envs.push.env import PushTask
from milx.evaluation import provenance
from milx.evaluation.intervals import wilson_interval
from milx.trajopt.sampling import Options, Search

NOISE = 0.1
"""Standard deviation on the actions; the presets'."""
ITERATIONS, ROUNDS, ROUNDS_FROM_NOTHING = 4, 2, 6
"""Iterations of a round, and how many rounds a batch has that begins with plans, and the first one from nothing."""
FIRST_SEED = 1000
"""Of the scenes; push.py and the trials by which settings were chosen have smaller ones."""
EVERY = 5
"""Time steps from one plan to the next."""
SEARCH = Options("cross_entropy", samples=32, elites=6, order=3, deviation_min=0.03, iterations=ITERATIONS)
AGAIN = Options("predictive", samples=32, order=3)
"""How a plan is searched for, and how what is left of it is planned again."""


def measure(scenes: int, batch: int, plans: int) -> Iterator[dict[str, Any]]:
    """Plans and executes `scenes` scenes, rounded up to whole batches, and yields what is known after each batch.

    Raises:
        RuntimeError: if fewer than `plans` plans of the first batch succeed.
    """
    env = make_env()
    planner = Planner(env, SEARCH, make_cheap_env())
    began = time.perf_counter()
    seconds: dict[str, float] = {}

    def done(what: str, since: float) -> None:
        seconds[what] = seconds.get(what, 0.0) + time.perf_counter() - since

    features, knots = _from_nothing(planner, batch)
    if len(knots) < plans:
        raise RuntimeError(f"only {len(knots)} plans of the first {batch} scenes succeeded, expected {plans}")
    first = len(knots)
    done("the first batch from nothing, with compilation", began)
    counts: list[int] = []
    for number in range(-(-scenes // batch)):
        task, start, key = draw(env, batch, FIRST_SEED + 1 + number)
        keys = jax.random.split(key)
        found = planner.features(task, start)
        since = time.perf_counter()
        search = planner.start_from(task, start, knots[nearest(found, features, plans)])
        search = jax.block_until_ready(_improve(planner, task, start, search, keys[0], ROUNDS))
        done("planning, with compilation", since)
        since = time.perf_counter()
        success = _execute(planner, task, start, search, keys[1])
        done("executing", since)
        features = np.concatenate([features, np.asarray(found)[success]])
        knots = np.concatenate([knots, np.asarray(search.knots)[success]])
        counts.append(int(success.sum()))
        total, made = time.perf_counter() - began, batch * len(counts)
        yield {
            "scenes": made,
            "first_plans": first,
            "success": sum(counts) / made,
            "wilson95": wilson_interval(sum(counts), made),
            "success_by_batch": [count / batch for count in counts],
            "seconds": {**seconds, "total": total},
            "scenes_per_second": made / total,
            "rollouts": {
                "from plans": plans,
                "search": ROUNDS * ITERATIONS * SEARCH.samples,
                "again": _again(env.horizon),
            },
        }


def _again(horizon: int) -> float:
    """Counts the rollouts of planning again, in whole episodes."""
    return AGAIN.samples * AGAIN.iterations * sum((horizon - now) / horizon for now in range(EVERY, horizon, EVERY))


def _improve(planner: Planner, task: PushTask, start: State, search: Search, key: jax.Array, rounds: int) -> Search:
    """Improves plans in every scene."""
    for round_key in jax.random.split(key, rounds):
        search = planner.improve(task, start, search, jax.random.split(round_key, len(search.knots)))
    return search


def _execute(planner: Planner, task: PushTask, start: State, search: Search, key: jax.Array) -> np.ndarray:
    """Executes plans under noise, and tells in which scenes [scenes] that succeeds."""
    keys = jax.random.split(key, len(search.knots))
    return np.asarray(planner.execute(task, start, search, keys, EVERY, AGAIN, NOISE, TRACKING))


def _from_nothing(planner: Planner, batch: int) -> tuple[np.ndarray, np.ndarray]:
    """Searches from nothing, and returns features and plans of the scenes in which their execution succeeds."""
    task, start, key = draw(planner.env, batch, FIRST_SEED)
    keys = jax.random.split(key)
    search = _improve(planner, task, start, planner.start(batch), keys[0], ROUNDS_FROM_NOTHING)
    success = _execute(planner, task, start, search, keys[1])
    return np.asarray(planner.features(task, start))[success], np.asarray(search.knots)[success]


def main(_: list[str]) -> None:
    """Measures, and writes the file."""
    milx.configure()
    settings = {"plans": _PLANS.value, "batch": _BATCH.value, "every": EVERY, "noise": NOISE, "tracking": TRACKING}
    settings |= {"rounds": ROUNDS, "rounds_from_nothing": ROUNDS_FROM_NOTHING, "first_seed": FIRST_SEED}
    settings |= {"knots": KNOTS, "deviation": DEVIATION, "near": NEAR}
    options = {"search": vars(SEARCH), "again": vars(AGAIN)}
    folder = pathlib.Path(_OUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    for found in measure(_SCENES.value, _BATCH.value, _PLANS.value):
        result = {"planner": "demonstrations", "settings": settings, "options": options, **found, **provenance.origin()}
        files.write_json(folder / "demonstrations.json", result)
        low, high = found["wilson95"]
        newest, total = found["success_by_batch"][-1], found["seconds"]["total"]
        print(
            f"{newest:.1%}; {found['success']:.2%} ({low:.2%} to {high:.2%}) of {found['scenes']} in {total:.0f} s",
            flush=True,
        )


if __name__ == "__main__":
    _SCENES = flags.DEFINE_integer("scenes", 9200, "Scenes, each of another task.", lower_bound=1)
    _BATCH = flags.DEFINE_integer("batch", 512, "Scenes at once.", lower_bound=1)
    _PLANS = flags.DEFINE_integer("plans", 64, "Plans of other scenes that a scene tries.", lower_bound=1)
    _OUT = flags.DEFINE_string("out", "experiments/results/planning", "Folder of the JSON file.")
    app.run(main)
