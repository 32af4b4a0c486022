"""How reliably push can be demonstrated by sampling, without a controller: success by the number of rollouts.

    python experiments/planning/push.py                    # on a GPU; what has its file is not run again
    python experiments/planning/push.py --rows=cem-32 --scenes=4 --iterations=2 --more=2

The planner (`milx.trajopt.planner`) samples velocities of the hand, which an operational-space law turns into torques.
It plans whole episodes for an arm without noise: in the first scenes from nothing, in other scenes from the cheapest of
the plans of the nearest of the first. Then it executes these under the presets' noise on the actions, in four ways: as
they are, tracking the path of the hand that the plan expects, planning the rest again every few time steps, or both.
Searches draw candidates of their own in every scene, otherwise than demonstrations, where all scenes draw the same.
"""

import dataclasses
import functools
import math
import pathlib
import time
from typing import Any

import jax
import jax.numpy as jnp
from absl import app, flags

import milx
from milx import envs
from milx.core import files
from milx.envs.base import Env, State, Task
from milx.evaluation import provenance
from milx.evaluation.intervals import wilson_interval
from milx.trajopt.planner import Planner, Plans, Settings
from milx.trajopt.sampling import Options, Search

NOISE = 0.1
"""Standard deviation on the actions; that of `paper` and `fast`."""
_CEM = functools.partial(Options, "cross_entropy", deviation_min=0.03)
ROWS = {
    "cem-32": _CEM(samples=32, elites=6, order=3),
    "cem-64": _CEM(samples=64, elites=8, order=3),
    "mppi-32": Options("mppi", samples=32, temperature=0.05, order=3),
    "predictive-32": Options("predictive", samples=32, order=3),
}
"""Planners by name."""


class Measurement:
    """Measures a planner in some scenes, which `seed` draws, each of another training task."""

    def __init__(self, env: Env, options: Options, scenes: int, seed: int):
        self.env, self.scenes = env, scenes
        self.settings = Settings(search=options, again=dataclasses.replace(options, iterations=1))
        self.planner = Planner(env, self.settings)
        task_key, scene_key, self._key = jax.random.split(jax.random.key(seed), 3)
        self.task = jax.vmap(env.sample_task, in_axes=(0, None))(jax.random.split(task_key, scenes), "train")
        self.start = jax.vmap(env.reset)(jax.random.split(scene_key, scenes), self.task)

    def keys(self, number: int) -> jax.Array:
        """Returns a key for each scene."""
        return jax.random.split(jax.random.fold_in(self._key, number), self.scenes)

    def execute(self, search: Search, again: bool = False, noise: float = 0.0, tracking: bool = False) -> jax.Array:
        """Executes the plans, and tells in which scenes that succeeds."""
        return self._execute(search, self.keys(1000), again, noise, tracking)

    @functools.partial(jax.jit, static_argnums=(0, 3, 5))
    def _execute(self, search: Search, keys: jax.Array, again: bool, noise: float, tracking: bool) -> jax.Array:
        every = self.settings.every if again else self.env.horizon
        planner = Planner(self.env, dataclasses.replace(self.settings, every=every))

        def one(task: Task, start: State, search: Search, key: jax.Array) -> jax.Array:
            states, _ = planner.execute(task, start, search, key, noise, tracking)
            return self.env.success(task, states)

        return jax.vmap(one)(self.task, self.start, search, keys)

    def begin(self) -> Search:
        """Begins without plans."""
        return jax.vmap(self.planner.begin, axis_size=self.scenes)()

    @functools.partial(jax.jit, static_argnums=0)
    def begin_from(self, plans: Plans) -> Search:
        """Begins with the plans of the nearest scenes."""
        return jax.vmap(self.planner.begin_from, in_axes=(0, 0, None))(self.task, self.start, plans)

    @functools.partial(jax.jit, static_argnums=0)
    def features(self) -> jax.Array:
        """Describes the scenes."""
        return jax.vmap(self.planner.features)(self.task, self.start)

    @functools.partial(jax.jit, static_argnums=0)
    def improve(self, search: Search, keys: jax.Array) -> Search:
        """Does one iteration."""
        return jax.vmap(functools.partial(self.planner.improve, iterations=1))(self.task, self.start, search, keys)

    def plan(self, search: Search, iterations: int, rollouts: int) -> tuple[Search, list[dict[str, Any]]]:
        """Improves plans.

        Args:
            search: [scenes], the plans.
            iterations: how often.
            rollouts: that each has cost before.

        Returns:
            The plans, and before and after every iteration: rollouts of a scene, success of the means, the median of
            the cheapest candidates' costs, and seconds, those of the first iteration with compilation.
        """
        curve = [self._point(search, rollouts, 0.0)]
        for number in range(iterations):
            began = time.perf_counter()
            search = jax.block_until_ready(self.improve(search, self.keys(number)))
            rollouts += self.settings.search.samples
            curve.append(self._point(search, rollouts, time.perf_counter() - began))
        return search, curve

    def _point(self, search: Search, rollouts: int, seconds: float) -> dict[str, Any]:
        found: dict[str, Any] = {
            "rollouts": rollouts,
            "success": float(self.execute(search).mean()),
            "seconds": seconds,
        }
        cost = float(jnp.median(search.cost))
        found["cheapest_cost"] = cost if math.isfinite(cost) else None
        print(found, flush=True)
        return found

    def under_noise(self, search: Search) -> dict[str, Any]:
        """Executes plans under noise in four ways."""
        ways = {
            "open loop": lambda: self.execute(search, noise=NOISE),
            "tracking": lambda: self.execute(search, False, NOISE, True),
            "planning the rest again": lambda: self.execute(search, True, NOISE),
            "tracking, and planning the rest again": lambda: self.execute(search, True, NOISE, True),
        }
        found = {}
        for way, execute in ways.items():
            count = int(execute().sum())
            found[way] = {"success": count / self.scenes, "wilson95": wilson_interval(count, self.scenes)}
            print(way, found[way], flush=True)
        return found


def measure(options: Options, scenes: int, iterations: int, more: int) -> dict[str, Any]:
    """Measures a planner from nothing in the first scenes, and from their plans and under noise in as many others."""
    env = envs.make("push", (16, 16))
    first, second = (Measurement(env, options, scenes, seed) for seed in (0, 1))
    search, from_nothing = first.plan(first.begin(), iterations, 0)
    plans = Plans(first.features(), search.knots, first.execute(search))
    began = time.perf_counter()
    search = jax.block_until_ready(second.begin_from(plans))
    seconds = time.perf_counter() - began
    search, from_plans = second.plan(search, more, min(first.settings.tried, scenes))
    from_plans[0]["seconds"] = seconds
    return {
        "scenes": scenes,
        "from_nothing": from_nothing,
        "plans_that_succeeded": int(plans.success.sum()),
        "from_plans": from_plans,
        "settings": dataclasses.asdict(first.settings),
        "noise": NOISE,
        "under_noise": second.under_noise(search),
    }


def main(_: list[str]) -> None:
    """Runs what is missing."""
    milx.configure()
    folder = pathlib.Path(_OUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    for name in _ROWS.value:
        path = folder / f"{name}.json"
        if not path.exists():
            print(name, flush=True)
            found = measure(ROWS[name], _SCENES.value, _ITERATIONS.value, _MORE.value)
            files.write_json(path, {"planner": name, "options": vars(ROWS[name]), **found, **provenance.origin()})


if __name__ == "__main__":
    _ROWS = flags.DEFINE_multi_enum("rows", list(ROWS), list(ROWS), "Which planners (repeat the flag).")
    _SCENES = flags.DEFINE_integer("scenes", 256, "Scenes, each of another task.", lower_bound=1)
    _ITERATIONS = flags.DEFINE_integer("iterations", 30, "Iterations from nothing.", lower_bound=1)
    _MORE = flags.DEFINE_integer("more", 12, "Iterations from plans of other scenes.", lower_bound=1)
    _OUT = flags.DEFINE_string("out", "experiments/results/planning", "Folder of the JSON files.")
    app.run(main)
