"""How reliably push can be demonstrated by sampling, without a controller: success by the number of rollouts.

    python experiments/planning/push.py                    # on a GPU; what has its file is not run again
    python experiments/planning/push.py --rows=cem-64 --scenes=4 --iterations=2

The planner samples velocities of the hand, which an operational-space law turns into torques. It plans whole episodes
for an arm without noise; then it executes them under the presets' noise on the actions, and plans again every few time
steps.
"""

import functools
import pathlib
import time
from typing import Any

import jax
import jax.numpy as jnp
from absl import app, flags

import milx
from milx import envs
from milx.core import files
from milx.envs.base import State
from milx.envs.push.env import Push, PushTask
from milx.evaluation import provenance
from milx.evaluation.intervals import wilson_interval
from milx.trajopt import sampling
from milx.trajopt.expert import problem_of
from milx.trajopt.ilqr import Problem
from milx.trajopt.operational_space import OperationalSpace, with_controls
from milx.trajopt.sampling import Options, Search

KNOTS = 10
LIMITS = (0.8, 0.8, 0.6, 3.0)
"""Of the hand's velocity along x, y and z (m/s), and of its turning about z (rad/s)."""
DEVIATION = (0.3, 0.3, 0.3, 1.0)
"""Standard deviation of the first candidates, in the same units."""
UPRIGHT = 6.0
"""Rate at which the hand returns to pointing down (1/s)."""
TIME_CONSTANT, REGULARIZATION = 0.06, 1e-2
"""Of the law: its time constant (s), a little more than a time step, and what bounds torques near singular poses."""
NOISE = 0.1
"""Standard deviation on the actions; the presets'."""
EVERY = (10, 20)
"""Time steps from one plan to the next, under noise."""
REPLANNED = 0.3
"""Standard deviation of candidates when planning again, as a fraction of the first ones'."""
_CEM = functools.partial(Options, "cross_entropy", deviation_min=0.03)
ROWS = {
    "cem-64": _CEM(samples=64, elites=8),
    "cem-256": _CEM(samples=256, elites=16),
    "mppi-64": Options("mppi", samples=64, temperature=0.05),
    "predictive-64": Options("predictive", samples=64),
    "cem-64-held": _CEM(samples=64, elites=8, order=0),
    "cem-64-cubic": _CEM(samples=64, elites=8, order=3),
}
"""Planners by name."""


class Planner:
    """Plans pushes of the hand by one of ROWS, one iteration at a time."""

    def __init__(self, env: Push, options: Options):
        self.env, self.options = env, options
        self._law = OperationalSpace(env.mj_model, "tip", time_constant=TIME_CONSTANT, regularization=REGULARIZATION)

    def action(self, state: State, velocity: jax.Array) -> jax.Array:
        """Computes the actions [7], not clipped, that move the hand so (velocity [4]) and keep it upright."""
        tilt = jnp.cross(self.env.hand(state.qpos)[6:9], jnp.array([0.0, 0.0, -1.0]))
        wanted = jnp.concatenate([velocity[:3], UPRIGHT * tilt[:2], velocity[3:]])
        # The objects' masses do not matter to the arm's law.
        return self._law.command(self.env.model, self.env.data(state), wanted)

    def problem(self, task: PushTask, start: State) -> Problem:
        """States the problem of a scene, with the environment's costs, in velocities of the hand."""
        problem = problem_of(self.env, task, start)
        limits = jnp.array(LIMITS)
        return with_controls(problem, lambda x, v: self.action(start.with_vector(x), v), -limits, limits)

    @functools.partial(jax.jit, static_argnums=0)
    def improve(self, task: PushTask, start: State, search: Search, key: jax.Array) -> tuple[Search, jax.Array]:
        """Does one iteration in every scene, and tells which of the plans succeed without noise."""

        def one(task: PushTask, start: State, search: Search, key: jax.Array) -> tuple[Search, jax.Array]:
            problem = self.problem(task, start)
            search = sampling.solve(problem, start.vector, search, self.env.horizon, key, self.options)
            controls = sampling.actions_of(problem, search.knots, self.env.horizon, self.options)
            after = lambda x, u: (problem.dynamics(x, u),) * 2  # noqa: E731
            return search, self._success(task, start, jax.lax.scan(after, start.vector, controls)[1])

        return jax.vmap(one)(task, start, search, key)

    @functools.partial(jax.jit, static_argnums=(0, 5))
    def execute(self, task: PushTask, start: State, search: Search, key: jax.Array, every: int) -> jax.Array:
        """Tells in which scenes plans succeed under noise, if one iteration plans again every so many time steps."""

        def one(task: PushTask, start: State, search: Search, key: jax.Array) -> jax.Array:
            def plant(x: jax.Array, velocity: jax.Array, key: jax.Array) -> jax.Array:
                action = jnp.clip(self.action(start.with_vector(x), velocity), *self.env.action_range)
                return self.env.step(task, start.with_vector(x), action + NOISE * jax.random.normal(key, (7,))).vector

            horizon, problem = self.env.horizon, self.problem(task, start)
            states, _ = sampling.control(
                problem, start.vector, search, horizon, horizon, every, key, self.options, plant
            )
            return self._success(task, start, states[1:])

        return jax.vmap(one)(task, start, search, key)

    def _success(self, task: PushTask, start: State, vectors: jax.Array) -> jax.Array:
        states = jax.vmap(start.with_vector)(jnp.concatenate([start.vector[None], vectors]))
        return self.env.success(task, states)


def measure(options: Options, scenes: int, iterations: int) -> dict[str, Any]:
    """Measures a planner: success after every iteration, and under noise after the last."""
    env = envs.make("push", (16, 16))
    planner, began = Planner(env, options), time.perf_counter()
    task_key, scene_key, key = jax.random.split(jax.random.key(0), 3)
    task = jax.vmap(env.sample_task, in_axes=(0, None))(jax.random.split(task_key, scenes), "train")
    start = jax.vmap(env.reset)(jax.random.split(scene_key, scenes), task)
    search = jax.vmap(lambda _: sampling.start(jnp.zeros((KNOTS, 4)), jnp.array(DEVIATION)))(jnp.arange(scenes))
    curve = []
    for number in range(iterations):
        search, success = planner.improve(
            task, start, search, jax.random.split(jax.random.fold_in(key, number), scenes)
        )
        curve.append({"rollouts": (number + 1) * options.samples, "success": float(success.mean())})
        curve[-1] |= {"cost": float(jnp.median(search.cost)), "seconds": time.perf_counter() - began}
        print(curve[-1], flush=True)
    search = search._replace(deviation=jnp.broadcast_to(REPLANNED * jnp.array(DEVIATION), search.deviation.shape))
    noisy = []
    for every in EVERY:
        began = time.perf_counter()
        success = planner.execute(
            task, start, search, jax.random.split(jax.random.fold_in(key, 1000 + every), scenes), every
        )
        count = int(success.sum())
        noisy.append({"every": every, "success": count / scenes, "wilson95": wilson_interval(count, scenes)})
        noisy[-1]["seconds"] = time.perf_counter() - began
        print(noisy[-1], flush=True)
    return {"scenes": scenes, "without_noise": curve, "noise": NOISE, "under_noise": noisy}


def main(_: list[str]) -> None:
    """Runs what is missing."""
    milx.configure()
    folder = pathlib.Path(_OUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    for name in _ROWS.value:
        path = folder / f"{name}.json"
        if not path.exists():
            print(name, flush=True)
            found = measure(ROWS[name], _SCENES.value, _ITERATIONS.value)
            files.write_json(path, {"planner": name, "options": vars(ROWS[name]), **found, **provenance.origin()})


if __name__ == "__main__":
    _ROWS = flags.DEFINE_multi_enum("rows", list(ROWS), list(ROWS), "Which planners (repeat the flag).")
    _SCENES = flags.DEFINE_integer("scenes", 256, "Scenes, each of another task.", lower_bound=1)
    _ITERATIONS = flags.DEFINE_integer("iterations", 16, "Iterations.", lower_bound=1)
    _OUT = flags.DEFINE_string("out", "experiments/results/planning", "Folder of the JSON files.")
    app.run(main)
