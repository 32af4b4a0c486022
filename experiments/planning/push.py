"""How reliably push can be demonstrated by sampling, without a controller: success by the number of rollouts.

    python experiments/planning/push.py                    # on a GPU; what has its file is not run again
    python experiments/planning/push.py --rows=cem-32 --scenes=4 --iterations=2 --more=2

The planner samples velocities of the hand, which an operational-space law turns into torques. It plans whole episodes
for an arm without noise: in the first scenes from nothing, in other scenes from the cheapest of a few plans that are
drawn among those that succeeded in the first. Then it executes these under the presets' noise on the actions, in four
ways: as they are, tracking the path of the hand without noise, planning the rest again every EVERY time steps, or both.
"""

import functools
import pathlib
import time
from typing import Any

import jax
import jax.numpy as jnp
from absl import app, flags
from planner import DEVIATION, KNOTS, NEAR, TRACKING, Planner, draw, make_env

import milx
from milx.core import files
from milx.evaluation import provenance
from milx.evaluation.intervals import wilson_interval
from milx.trajopt.sampling import Options, Search

PLANS = 64
"""Plans that a scene tries, drawn with replacement."""
NOISE = 0.1
"""Standard deviation on the actions; the presets'."""
EVERY = 20
"""Time steps from one plan to the next, where it plans again."""
_CEM = functools.partial(Options, "cross_entropy", deviation_min=0.03)
ROWS = {
    "cem-32": _CEM(samples=32, elites=6, order=3),
    "cem-64": _CEM(samples=64, elites=8, order=3),
    "mppi-32": Options("mppi", samples=32, temperature=0.05, order=3),
    "predictive-32": Options("predictive", samples=32, order=3),
}
"""Planners by name."""


class Measurement:
    """Measures a planner in some scenes, which `seed` draws."""

    def __init__(self, planner: Planner, scenes: int, seed: int):
        self.planner, self.scenes = planner, scenes
        self.task, self.start, self._key = draw(planner.env, scenes, seed)

    def keys(self, number: int) -> jax.Array:
        """Returns a key for each scene."""
        return jax.random.split(jax.random.fold_in(self._key, number), self.scenes)

    def execute(self, search: Search, every: int | None = None, noise: float = 0.0, rate: float = 0.0) -> jax.Array:
        """Executes the plans; see `Planner.execute`. They are kept unless `every` is given."""
        every = every or self.planner.env.horizon
        keys, again = self.keys(1000), self.planner.options
        return self.planner.execute(self.task, self.start, search, keys, every, again, noise, rate)

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
            search = jax.block_until_ready(self.planner.improve(self.task, self.start, search, self.keys(number)))
            rollouts += self.planner.options.samples
            curve.append(self._point(search, rollouts, time.perf_counter() - began))
        return search, curve

    def _point(self, search: Search, rollouts: int, seconds: float) -> dict[str, Any]:
        found = {"rollouts": rollouts, "success": float(self.execute(search).mean()), "seconds": seconds}
        found["cheapest_cost"] = float(jnp.median(search.cost))
        print(found, flush=True)
        return found

    def under_noise(self, search: Search) -> dict[str, Any]:
        """Executes plans under noise in four ways."""
        ways = {
            "open loop": lambda: self.execute(search, noise=NOISE),
            "tracking": lambda: self.execute(search, noise=NOISE, rate=TRACKING),
            f"planning the rest again every {EVERY} steps": lambda: self.execute(search, EVERY, NOISE),
            f"tracking, and planning the rest again every {EVERY} steps": lambda: self.execute(
                search, EVERY, NOISE, TRACKING
            ),
        }
        found = {}
        for way, execute in ways.items():
            count = int(execute().sum())
            found[way] = {"success": count / self.scenes, "wilson95": wilson_interval(count, self.scenes)}
            print(way, found[way], flush=True)
        return found


def measure(options: Options, scenes: int, iterations: int, more: int) -> dict[str, Any]:
    """Measures a planner: from nothing in the first scenes, from their plans in as many others, and under noise there.

    Raises:
        RuntimeError: if no plan succeeds in the first scenes.
    """
    planner = Planner(make_env(), options)
    first = Measurement(planner, scenes, 0)
    search, from_nothing = first.plan(planner.start(scenes), iterations, 0)
    good = search.knots[first.execute(search)]
    if not len(good):
        raise RuntimeError(f"no plan of {scenes} scenes succeeded after {iterations} iterations")
    second = Measurement(planner, scenes, 1)
    plans = jax.random.choice(jax.random.key(2), good, (scenes, PLANS))
    began = time.perf_counter()
    search = jax.block_until_ready(planner.start_from(second.task, second.start, plans))
    seconds = time.perf_counter() - began
    search, from_plans = second.plan(search, more, PLANS)
    from_plans[0]["seconds"] = seconds
    return {
        "scenes": scenes,
        "from_nothing": from_nothing,
        "plans_that_succeeded": len(good),
        "from_plans": from_plans,
        "settings": {"knots": KNOTS, "deviation": DEVIATION, "plans": PLANS, "near": NEAR},
        "noise": NOISE,
        "tracking": TRACKING,
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
