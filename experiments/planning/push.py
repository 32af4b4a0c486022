"""How reliably push can be demonstrated by sampling, without a controller: success by the number of rollouts.

    python experiments/planning/push.py                    # on a GPU; what has its file is not run again
    python experiments/planning/push.py --rows=cem-32 --scenes=4 --iterations=2 --more=2

The planner samples velocities of the hand, which an operational-space law turns into torques. It plans whole episodes
for an arm without noise: in the first scenes from nothing, in other scenes from the cheapest of a few plans that are
drawn among those that succeeded in the first. Then it executes these under the presets' noise on the actions, in three
ways: as they are, tracking the path of the hand without noise, or planning again every EVERY time steps.
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
PLANS, NEAR = 64, 0.3
"""Plans that a scene tries, drawn with replacement, and the deviation of the first candidates then and when planning
again, as a fraction of DEVIATION."""
UPRIGHT = 6.0
"""Rate at which the hand returns to pointing down (1/s)."""
TIME_CONSTANT, REGULARIZATION = 0.06, 1e-2
"""Of the law: its time constant (s), a little more than a time step, and what bounds torques near singular poses."""
NOISE = 0.1
"""Standard deviation on the actions; the presets'."""
TRACKING = 6.0
"""Rate at which the hand returns to its path when it tracks it (1/s)."""
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
    def start_from(self, task: PushTask, start: State, plans: jax.Array) -> Search:
        """Begins a search in every scene, from the cheapest of its own plans [scenes, PLANS, KNOTS, 4]."""

        def one(task: PushTask, start: State, plans: jax.Array) -> Search:
            problem, deviation = self.problem(task, start), NEAR * jnp.array(DEVIATION)
            return sampling.start_from(problem, start.vector, plans, deviation, self.env.horizon, self.options)

        return jax.vmap(one)(task, start, plans)

    @functools.partial(jax.jit, static_argnums=0)
    def improve(self, task: PushTask, start: State, search: Search, key: jax.Array) -> Search:
        """Does one iteration in every scene."""

        def one(task: PushTask, start: State, search: Search, key: jax.Array) -> Search:
            problem = self.problem(task, start)
            return sampling.solve(problem, start.vector, search, self.env.horizon, key, self.options)

        return jax.vmap(one)(task, start, search, key)

    @functools.partial(jax.jit, static_argnums=0)
    def execute(
        self,
        task: PushTask,
        start: State,
        search: Search,
        key: jax.Array,
        noise: jax.Array,
        rate: jax.Array,
        path: jax.Array,
    ) -> tuple[jax.Array, jax.Array]:
        """Executes the plans.

        Args:
            task: [scenes].
            start: [scenes], where they begin.
            search: [scenes], their plans.
            key: [scenes], for the noise.
            noise: standard deviation on the actions, which lie in [-1, 1].
            rate: at which the hand returns to its path (1/s); velocities that return it may exceed LIMITS.
            path: [scenes, T, 4], x, y, z (m) and turn (rad) of the hand at the beginning of every time step.

        Returns:
            In which scenes that succeeded, and the paths [scenes, T, 4] of the hand.
        """

        def one(task: PushTask, start: State, search: Search, key: jax.Array, path: jax.Array):
            controls = sampling.actions_of(self.problem(task, start), search.knots, self.env.horizon, self.options)

            def step(x: jax.Array, inputs: tuple[jax.Array, jax.Array, jax.Array]):
                velocity, wanted, key = inputs
                hand = self.hand(start.with_vector(x))
                away = wanted - hand
                away = away.at[3].set(jnp.arctan2(jnp.sin(away[3]), jnp.cos(away[3])))
                after = self._act(task, start.with_vector(x), velocity + rate * away, noise, key)
                return after, (after, hand)

            inputs = controls, path, jax.random.split(key, self.env.horizon)
            _, (vectors, hands) = jax.lax.scan(step, start.vector, inputs)
            return self._success(task, start, jnp.concatenate([start.vector[None], vectors])), hands

        return jax.vmap(one)(task, start, search, key, path)

    @functools.partial(jax.jit, static_argnums=0)
    def replan(self, task: PushTask, start: State, search: Search, key: jax.Array) -> jax.Array:
        """Tells in which scenes plans succeed under noise, if one iteration plans again every EVERY time steps.

        It plans a whole horizon from there on, past the end of the episode. Moving the knots on changes a plan a little
        unless EVERY is a multiple of their interval.
        """

        def one(task: PushTask, start: State, search: Search, key: jax.Array) -> jax.Array:
            def plant(x: jax.Array, velocity: jax.Array, key: jax.Array) -> jax.Array:
                return self._act(task, start.with_vector(x), velocity, NOISE, key)

            horizon, problem = self.env.horizon, self.problem(task, start)
            states, _ = sampling.control(
                problem, start.vector, search, horizon, horizon, EVERY, key, self.options, plant
            )
            return self._success(task, start, states)

        return jax.vmap(one)(task, start, search, key)

    def hand(self, state: State) -> jax.Array:
        """Returns x, y, z (m) of the hand, and its turn about z (rad)."""
        hand = self.env.hand(state.qpos)
        return jnp.append(hand[:3], jnp.arctan2(hand[4], hand[3]))

    def _act(
        self, task: PushTask, state: State, velocity: jax.Array, noise: jax.Array | float, key: jax.Array
    ) -> jax.Array:
        action = jnp.clip(self.action(state, velocity), *self.env.action_range)
        return self.env.step(task, state, action + noise * jax.random.normal(key, action.shape)).vector

    def _success(self, task: PushTask, start: State, vectors: jax.Array) -> jax.Array:
        return self.env.success(task, jax.vmap(start.with_vector)(vectors))


class Measurement:
    """Measures a planner in some scenes, which `seed` draws."""

    def __init__(self, planner: Planner, scenes: int, seed: int):
        self.planner, self.scenes = planner, scenes
        task_key, scene_key, self._key = jax.random.split(jax.random.key(seed), 3)
        env = planner.env
        self.task = jax.vmap(env.sample_task, in_axes=(0, None))(jax.random.split(task_key, scenes), "train")
        self.start = jax.vmap(env.reset)(jax.random.split(scene_key, scenes), self.task)

    def keys(self, number: int) -> jax.Array:
        """Returns a key for each scene."""
        return jax.random.split(jax.random.fold_in(self._key, number), self.scenes)

    def execute(self, search: Search, noise: float, rate: float, path: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Executes the plans; see `Planner.execute`."""
        return self.planner.execute(self.task, self.start, search, self.keys(1000), noise, rate, path)

    def path(self, search: Search) -> tuple[jax.Array, jax.Array]:
        """Tells which plans succeed without noise, and how the hand moves then."""
        return self.execute(search, 0.0, 0.0, jnp.zeros((self.scenes, self.planner.env.horizon, 4)))

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
        found = {"rollouts": rollouts, "success": float(self.path(search)[0].mean()), "seconds": seconds}
        found["cheapest_cost"] = float(jnp.median(search.cost))
        print(found, flush=True)
        return found

    def under_noise(self, search: Search) -> dict[str, Any]:
        """Executes plans under noise in three ways."""
        path = self.path(search)[1]
        deviation = jnp.broadcast_to(NEAR * jnp.array(DEVIATION), search.deviation.shape)
        ways = {
            "open loop": lambda: self.execute(search, NOISE, 0.0, path)[0],
            "tracking": lambda: self.execute(search, NOISE, TRACKING, path)[0],
            f"planning again every {EVERY} steps": lambda: self.planner.replan(
                self.task, self.start, search._replace(deviation=deviation), self.keys(2000)
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
    planner = Planner(envs.make("push", (16, 16)), options)
    first = Measurement(planner, scenes, 0)
    begin = jax.vmap(sampling.start, in_axes=None, axis_size=scenes)
    search = begin(jnp.zeros((KNOTS, 4)), jnp.array(DEVIATION))
    search, from_nothing = first.plan(search, iterations, 0)
    good = search.knots[first.path(search)[0]]
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
