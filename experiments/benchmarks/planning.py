"""The cross-entropy method beside hydrax: what its plans cost, and rollouts per second, in one scene of push.

    pip install git+https://github.com/vincekurtz/hydrax@02ac1c4a91a33897dc0e8f2d6f8a468a24b72018
    python experiments/benchmarks/planning.py
    python experiments/benchmarks/planning.py --samples=16 --iterations=2 --seeds=1 --repeats=1

Both search torques of the seven motors, as a linear spline of ten knots for the whole episode, from zero, with the same
model, costs, deviations and numbers of candidates and elites. hydrax carries all of MJX's data from step to step, so
that its contact solver starts from the last step's forces, and calls `mjx.forward` once more in each time step; milx
has the mean and the last cheapest candidate among the candidates. milx searches velocities of the hand besides, in the
environment and in its approximation (`milx.trajopt.planner`). What the means of all searches cost in the end is
computed in the environment, by one program for torques and one for velocities.
"""

import functools
import pathlib
import statistics
from collections.abc import Callable
from typing import Any, NamedTuple

import common
import jax
import jax.numpy as jnp
from absl import app, flags
from mujoco import mjx

import milx
from milx import envs
from milx.envs.base import State
from milx.trajopt import sampling
from milx.trajopt.episode import approximated, problem_of, steered
from milx.trajopt.ilqr import Problem
from milx.trajopt.sampling import Options

_OUT = flags.DEFINE_string("out", str(common.RESULTS), "Folder of the JSON file.")
_SAMPLES = flags.DEFINE_integer("samples", 2048, "Candidates of an iteration.", lower_bound=16)
_ITERATIONS = flags.DEFINE_integer("iterations", 10, "Iterations of a search.", lower_bound=1)
_SEEDS = flags.DEFINE_integer("seeds", 3, "Searches; their median is shown.", lower_bound=1)
_REPEATS = flags.DEFINE_integer("repeats", 10, "Timed iterations, after one to warm up.", lower_bound=1)
DEVIATION, DEVIATION_MIN = 0.3, 0.03
"""Of the first candidates in torques, in units of their limits, and the least one of all; velocities begin with the
planner's own."""
CANDIDATES_PER_ELITE, KNOTS = 8, 10


class Searcher(NamedTuple):
    """A way to search.

    Attributes:
        begin: a seed -> what its search begins with.
        iterate: what the search has, key -> what it has after an iteration; jitted.
        cost: what the search has -> the cost of its mean in the environment.
    """

    begin: Callable[[int], Any]
    iterate: Callable[[Any, jax.Array], Any]
    cost: Callable[[Any], jax.Array]


class Scene:
    """A scene of push.

    Args:
        samples: candidates of an iteration.
    """

    def __init__(self, samples: int):
        self.env, self.samples, self.elites = envs.make("push", (16, 16)), samples, samples // CANDIDATES_PER_ELITE
        self.task = self.env.sample_task(jax.random.key(0), "train")
        self.start = self.env.reset(jax.random.key(1), self.task)
        self.options = Options("cross_entropy", samples, order=1, elites=self.elites, deviation_min=DEVIATION_MIN)
        self._torques = problem_of(self.env, self.task, self.start)
        self._velocities = steered(self.env, self.task, self.start)
        self._cost_of_torques, self._cost_of_velocities = map(self._cost, (self._torques, self._velocities))

    def torques(self) -> Searcher:
        """Prepares milx's search in torques."""
        return self._search(self._torques, self._cost_of_torques, jnp.full(self.env.action_size, DEVIATION))

    def velocities(self, approximate: bool) -> Searcher:
        """Prepares milx's search in velocities of the hand."""
        problem = self._velocities
        if approximate:
            problem = approximated(problem)
        return self._search(problem, self._cost_of_velocities, self.env.steering.deviation)

    def _search(self, problem: Problem, cost: Callable[[jax.Array], jax.Array], deviation: jax.Array) -> Searcher:
        @jax.jit
        def iterate(search: sampling.Search, key: jax.Array) -> sampling.Search:
            return sampling.solve(problem, self.start.vector, search, self.env.horizon, key, self.options)

        begin = sampling.start(jnp.zeros((KNOTS, len(deviation))), deviation)
        return Searcher(lambda _: begin, iterate, lambda search: cost(search.knots))

    def _cost(self, problem: Problem) -> Callable[[jax.Array], jax.Array]:
        """Makes a program that computes the cost of a plan [KNOTS, k]."""

        def cost(knots: jax.Array) -> jax.Array:
            start, horizon = self.start.vector, self.env.horizon
            return sampling.start_from(problem, start, knots[None], 0.0, horizon, self.options).cost

        return jax.jit(cost)

    def hydrax(self) -> Searcher:
        """Prepares hydrax's search in torques.

        Raises:
            ImportError: if it is not installed.
        """
        from hydrax.algs import CEM
        from hydrax.task_base import Task

        env, task, start = self.env, self.task, self.start
        step = env.substeps * env.mj_model.opt.timestep

        class PushAsItIs(Task):
            """The environment's model of the task, and its costs; hydrax multiplies running costs by the time step."""

            def __init__(self) -> None:
                super().__init__(env.mj_model)
                self.model = env.model_of(task)

            def running_cost(self, state: mjx.Data, control: jax.Array) -> jax.Array:
                """Computes half the running residual's square, per second."""
                residual = env.running_residual(task, _state(start, state), control, jnp.int32(0))
                return 0.5 * residual @ residual / step

            def terminal_cost(self, state: mjx.Data) -> jax.Array:
                """Computes half the terminal residual's square."""
                residual = env.terminal_residual(task, _state(start, state))
                return 0.5 * residual @ residual

        sizes = {"num_samples": self.samples, "num_elites": self.elites, "num_knots": KNOTS}
        sigma = {"sigma_start": DEVIATION, "sigma_min": DEVIATION_MIN}
        planned = PushAsItIs()
        search = CEM(planned, **sizes, **sigma, T=env.horizon * step, dt=step, spline_type="linear")
        optimize, first = jax.jit(search.optimize), env.data(start)
        return Searcher(
            search.init_params,
            lambda params, _: optimize(first, params)[0],
            lambda params: self._cost_of_torques(params.mean),
        )


def _state(start: State, data: mjx.Data) -> State:
    return start.with_vector(jnp.concatenate([data.qpos, data.qvel]))


def main(_: list[str]) -> None:
    """Measures all searches, one after the other."""
    milx.configure()
    report, scene = common.Report("planning", pathlib.Path(_OUT.value)), Scene(_SAMPLES.value)
    rollouts = _ITERATIONS.value * _SAMPLES.value

    def measure(name: str, prepare: Callable[[], Searcher]) -> tuple[float, None]:
        """Adds the row of the rate, and returns the median of the costs."""
        searcher, costs = prepare(), []
        for seed in range(_SEEDS.value):
            search = searcher.begin(seed)
            for key in jax.random.split(jax.random.key(seed), _ITERATIONS.value):
                search = searcher.iterate(search, key)
            costs.append(float(searcher.cost(search)))
        ms = common.median_ms(searcher.iterate, searcher.begin(0), jax.random.key(0), repeats=_REPEATS.value)
        rate = 1e3 * _SAMPLES.value / ms
        report.add(f"rollouts of {_SAMPLES.value} candidates of push at once: {name}", rate, "1/s")
        return statistics.median(costs), None

    for name, prepare in {
        "milx, torques": scene.torques,
        "hydrax, torques": scene.hydrax,
        "milx, velocities of the hand": lambda: scene.velocities(approximate=False),
        "milx, velocities of the hand, cheaper physics": lambda: scene.velocities(approximate=True),
    }.items():
        add = report.attempt if prepare == scene.hydrax else report.measure
        label, note = f"cost of push after {rollouts} rollouts: {name}", f"median of {_SEEDS.value} searches"
        add(label, "", functools.partial(measure, name, prepare), note)


if __name__ == "__main__":
    app.run(main)
