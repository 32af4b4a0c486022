"""Sampling-based planning: predictive sampling, the cross-entropy method and path integrals (MPPI).

The problem is that of `ilqr.py`. Nothing is differentiated, so contacts may come early, late or not at all. The actions
are a spline of K knots θ in R^{K x m},

    u_t = clip(Σ_k B_tk θ_k, low, high),

where B [T, K] holds each knot for T/K steps (order 0), or interpolates linearly (1) or by a natural cubic spline (3)
between knots at even intervals from the first step to the last.
One iteration draws N candidates around a mean θ̄. The first is the mean itself; the second, if there is one, is the
cheapest candidate θ* of the last iteration with a finite cost, unless θ* is the mean; the others are random,

    θ_0 = clip(θ̄, low, high)    θ_1 = clip(θ*, low, high)    θ_i = clip(θ̄ + σ ε_i, low, high)  with  ε_i ~ N(0, I),

rolls all of them out, and moves the mean by their costs J_i:

    predictive sampling    θ̄ ← θ_i of the lowest J_i
    cross-entropy          θ̄, σ ← mean and standard deviation of the E cheapest candidates, σ at least σ_min
                           (of those among them whose cost is finite; one alone leaves σ as it is)
    MPPI                   θ̄ ← Σ_i w_i θ_i / Σ_i w_i    with  w_i = exp(-(J_i - min_j J_j) / λ).

Candidates with a state that is not finite cost infinitely much; where all do, θ̄, σ and θ* stay.

References:
    Howell et al., "Predictive sampling: real-time behaviour synthesis with MuJoCo", arXiv:2212.00541.
    Rubinstein & Kroese, "The cross-entropy method", Springer 2004.
    Pinneri et al., "Sample-efficient cross-entropy method for real-time planning", CoRL 2020 (keeps cheap candidates).
    Williams et al., "Information theoretic MPC for model-based reinforcement learning", ICRA 2017.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.interpolate
from jax import lax

from milx.trajopt.ilqr import Problem

ORDERS = (0, 1, 3)
_ROUNDING = 1e-9
"""By which a time step may be rounded, in intervals between knots."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Settings of the planner.

    Attributes:
        update: how candidates move the mean, one of UPDATES.
        samples: N.
        iterations: how often.
        order: of the spline, one of ORDERS.
        elites: E, for the cross-entropy method.
        deviation_min: σ_min, for the cross-entropy method, in the units of the actions.
        temperature: λ, for MPPI, in the units of the cost.

    Raises:
        ValueError: for a value that is not allowed, or more elites than samples.
    """

    update: str = "predictive"
    samples: int = 64
    iterations: int = 1
    order: int = 1
    elites: int = 8
    deviation_min: float = 0.0
    temperature: float = 1.0

    def __post_init__(self) -> None:
        for field, allowed in (("update", tuple(UPDATES)), ("order", ORDERS)):
            if (value := getattr(self, field)) not in allowed:
                raise ValueError(f"{field}: got {value!r}, expected one of {', '.join(map(str, allowed))}")
        for field in ("samples", "iterations"):
            if (value := getattr(self, field)) < 1:
                raise ValueError(f"{field}: got {value}, expected at least 1")
        if self.deviation_min < 0:
            raise ValueError(f"deviation_min: got {self.deviation_min}, expected at least 0")
        if self.temperature <= 0:
            raise ValueError(f"temperature: got {self.temperature}, expected more than 0")
        if self.update == "cross_entropy" and not 1 < self.elites <= self.samples:
            raise ValueError(f"elites: got {self.elites}, expected 2 to samples = {self.samples}")


class Search(NamedTuple):
    """What one plan hands to the next.

    Attributes:
        knots: [K, m], θ̄.
        deviation: [K, m], σ, in the units of the actions.
        best: [K, m], θ*; θ̄ before the first iteration.
        cost: the lowest J_i of the last iteration, inf if all diverged. Before the first iteration: inf after `start`,
            the cost of θ̄ after `start_from`.
    """

    knots: jax.Array
    deviation: jax.Array
    best: jax.Array
    cost: jax.Array


def start(knots: jax.Array, deviation: jax.Array | float) -> Search:
    """Begins a search around knots [K, m]; `deviation` is broadcast to the same shape."""
    knots = jnp.asarray(knots, float)
    deviation = jnp.broadcast_to(jnp.asarray(deviation, knots.dtype), knots.shape)
    return Search(knots, deviation, knots, jnp.full((), jnp.inf, knots.dtype))


def start_from(
    problem: Problem,
    initial_state: jax.Array,
    plans: jax.Array,
    deviation: jax.Array | float,
    horizon: int,
    options: Options,
) -> Search:
    """Begins a search around the cheapest of several plans, for example those of similar scenes.

    Args:
        problem: what to solve.
        initial_state: x_0, [n].
        plans: their knots, [M, K, m], which are clipped to the problem's limits.
        deviation: of the search, broadcast to [K, m].
        horizon: T.
        options: settings, of which `order` counts.

    Returns:
        A search whose θ̄ and θ* are the cheapest plan; the first one if all diverge, with a cost of inf.
    """
    plans = jnp.clip(plans.astype(initial_state.dtype), problem.control_low, problem.control_high)
    costs = _costs(problem, initial_state, plans, horizon, options, 0)
    cheapest = jnp.argmin(costs)
    return start(plans[cheapest], deviation)._replace(cost=costs[cheapest])


def basis(order: int, steps: np.ndarray, horizon: int, knots: int) -> np.ndarray:
    """Computes the rows [len(steps), K] of B at these time steps, which need not be whole, of T = `horizon`.

    Steps after the last one get the last one's row.

    Raises:
        ValueError: if there is no knot, or more than one for each time step.
    """
    if not 1 <= knots <= horizon:
        raise ValueError(f"knots: got {knots}, expected 1 to {horizon}, the time steps")
    at, when = knot_times(order, horizon, knots), np.clip(steps, 0, horizon - 1)
    if order == 0:
        return np.eye(knots)[np.floor(when * knots / horizon + _ROUNDING).astype(int)]
    if knots == 1:
        return np.ones((len(when), 1))
    if order == 1:
        return np.stack([np.interp(when, at, row) for row in np.eye(knots)], axis=1)
    return scipy.interpolate.CubicSpline(at, np.eye(knots), bc_type="natural")(when)


def knot_times(order: int, horizon: int, knots: int) -> np.ndarray:
    """Returns the time steps [K] of the knots."""
    return np.arange(knots) * horizon / knots if order == 0 else np.linspace(0, horizon - 1, knots)


def actions_of(problem: Problem, knots: jax.Array, horizon: int, options: Options) -> jax.Array:
    """Returns the actions [T, m] of knots [K, m]."""
    rows = jnp.asarray(basis(options.order, np.arange(horizon), horizon, len(knots)), knots.dtype)
    return jnp.clip(rows @ knots, problem.control_low, problem.control_high)


def _costs(
    problem: Problem,
    initial_state: jax.Array,
    knots: jax.Array,
    horizon: int,
    options: Options,
    now: jax.Array | int,
) -> jax.Array:
    """Returns J [N] of candidates [N, K, m], from step `now` on."""
    actions = jax.vmap(lambda knots: actions_of(problem, knots, horizon, options))(knots)
    return jax.vmap(lambda actions: _cost(problem, initial_state, actions, now))(actions)


def _cost(problem: Problem, initial_state: jax.Array, actions: jax.Array, now: jax.Array | int) -> jax.Array:
    """Rolls the actions [T, m] from step `now` on out and returns J; inf if a state is not finite."""

    def step(t: jax.Array, rolled: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        x, cost, finite = rolled
        r = problem.running_residual(x, actions[t], t.astype(jnp.int32))
        after = problem.dynamics(x, actions[t])
        return after, cost + 0.5 * r @ r, finite & jnp.isfinite(after).all()

    begin = initial_state, jnp.zeros((), initial_state.dtype), jnp.array(True)
    last, cost, finite = lax.fori_loop(now, len(actions), step, begin)
    r_T = problem.terminal_residual(last)
    cost = cost + 0.5 * r_T @ r_T
    return jnp.where(finite & jnp.isfinite(cost), cost, jnp.inf)


def solve(
    problem: Problem,
    initial_state: jax.Array,
    search: Search,
    horizon: int,
    key: jax.Array,
    options: Options,
    now: jax.Array | int = 0,
) -> Search:
    """Goes on with a search from an initial state, in whose data type everything is computed.

    Pure and jittable; `jax.vmap` gives batches with a key for each.

    Args:
        problem: what to solve; `approximation` is not used.
        initial_state: x_0, [n]; with `now`, the state at that step.
        search: around what to look.
        horizon: T, time steps of a whole plan.
        key: draws the candidates.
        options: settings.
        now: the step at which candidates begin; J_i then adds up the running costs from there on, and the terminal
            cost. All knots vary, since a spline's later actions may depend on earlier knots.
    """

    def iterate(search: Search, key: jax.Array) -> tuple[Search, None]:
        noise = jax.random.normal(key, (options.samples, *search.knots.shape), search.knots.dtype).at[0].set(0.0)
        candidates = search.knots + search.deviation * noise
        kept = (search.best != search.knots).any()
        candidates = jnp.where(kept, candidates.at[1:2].set(search.best), candidates)
        candidates = jnp.clip(candidates, problem.control_low, problem.control_high)
        costs = _costs(problem, initial_state, candidates, horizon, options, now)
        moved = UPDATES[options.update](search, candidates, costs, options)
        moved = moved._replace(best=candidates[jnp.argmin(costs)])
        least = costs.min()
        search = jax.tree.map(lambda new, old: jnp.where(jnp.isfinite(least), new, old), moved, search)
        return search._replace(cost=least), None

    search = jax.tree.map(lambda x: x.astype(initial_state.dtype), search)
    return lax.scan(iterate, search, jax.random.split(key, options.iterations))[0]


def _predictive(search: Search, candidates: jax.Array, costs: jax.Array, options: Options) -> Search:
    return search._replace(knots=candidates[jnp.argmin(costs)])


def _cross_entropy(search: Search, candidates: jax.Array, costs: jax.Array, options: Options) -> Search:
    best = lax.top_k(-costs, options.elites)[1]
    finite = jnp.isfinite(costs[best])[:, None, None]
    mean = candidates[best].mean(axis=0, where=finite)
    deviation = jnp.where(finite.sum() > 1, candidates[best].std(axis=0, where=finite), search.deviation)
    return search._replace(knots=mean, deviation=jnp.maximum(deviation, options.deviation_min))


def _mppi(search: Search, candidates: jax.Array, costs: jax.Array, options: Options) -> Search:
    weights = jnp.exp(-(costs - costs.min()) / options.temperature)
    return search._replace(knots=jnp.tensordot(weights / weights.sum(), candidates, axes=1))


UPDATES = {"predictive": _predictive, "cross_entropy": _cross_entropy, "mppi": _mppi}
"""How the mean moves, by name."""
