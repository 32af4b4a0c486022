"""Control-limited iterative LQR, the planner behind the expert demonstrations.

The problem: over T steps from a given x_0, with states x in R^n and actions u in R^m,

    minimize    J = Σ_{t<T} ½ |r(x_t, u_t, t)|² + ½ |r_T(x_T)|²
    subject to  x_{t+1} = f(x_t, u_t)  and  low ≤ u_t ≤ high.

One iteration improves a plan (x̄, ū). With A = f_x, B = f_u, r_x and r_u taken along the plan and a prime for the next
step, the backward pass begins at V_x = r_T,xᵀ r_T, V_xx = r_T,xᵀ r_T,x and finds, from the last step to the first,

    Q_u = r_uᵀ r + Bᵀ V_x'        Q_uu = r_uᵀ r_u + Bᵀ (V_xx' + μI) B        Q_ux = r_uᵀ r_x + Bᵀ (V_xx' + μI) A
    k = argmin ½ kᵀ Q_uu k + kᵀ Q_u  subject to  low ≤ ū + k ≤ high
    K = -Q_uu⁻¹ Q_ux in the dimensions that no limit holds, zero in the others
    V_x = Sᵀ (r + r_u k) + Fᵀ (V_x' + V_xx' B k)        V_xx = SᵀS + Fᵀ V_xx' F    with  F = A + B K,  S = r_x + r_u K.

The forward pass rolls out u = ū + α k + K (x - x̄) with several step sizes α at once and keeps the cheapest plan. The
regularization μ holds new states near the old ones: it grows when no step size lowers the cost and shrinks when one
does. Costs written as residuals have Gauss-Newton Hessians: V_xx, a sum of squares, is never indefinite, and nothing
asks for second derivatives of f or for reverse mode, which MJX lacks.

References:
    Tassa, Erez & Todorov, "Synthesis and stabilization of complex behaviors through online trajectory optimization",
        IROS 2012: the backward pass with its improved regularization and value update, the schedule of μ.
    Tassa, Mansard & Todorov, "Control-limited differential dynamic programming", ICRA 2014: the limits (box-DDP).
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from milx.core.linear_algebra import solve_free
from milx.trajopt import boxqp
from milx.trajopt.linearize import linearize


class Problem(NamedTuple):
    """An optimal control problem, as stated at the head of this file.

    Attributes:
        dynamics: f, maps x [n] and u [m] to the next x [n].
        running_residual: r, maps x [n], u [m] and the step t (int32 scalar) to a vector.
        terminal_residual: r_T, maps x [n] to a vector.
        control_low: [m], may be -inf.
        control_high: [m], may be inf.
        approximation: a cheaper function from which A and B are computed instead of from f; None for f itself. Rollouts
            and their costs are always those of f.
    """

    dynamics: Callable[[jax.Array, jax.Array], jax.Array]
    running_residual: Callable[[jax.Array, jax.Array, jax.Array], jax.Array]
    terminal_residual: Callable[[jax.Array], jax.Array]
    control_low: jax.Array
    control_high: jax.Array
    approximation: Callable[[jax.Array, jax.Array], jax.Array] | None = None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Plan:
    """A trajectory and the feedback around it: u = actions[t] + gains[t] @ (x - states[t]).

    Attributes:
        states: [T + 1, n].
        actions: [T, m], within the limits.
        gains: [T, m, n], K of the plan at the last μ; zero throughout if the plan has no finite linear model.
        cost: J of the plan; inf if no finite rollout was found, not even with the initial actions.
        iterations: the number of iterations run, failed line searches included.
        converged: whether `Options.tolerance` was met.
    """

    states: jax.Array
    actions: jax.Array
    gains: jax.Array
    cost: jax.Array
    iterations: jax.Array
    converged: jax.Array


@dataclasses.dataclass(frozen=True)
class Options:
    """Settings of the solver.

    Attributes:
        iterations: the most iterations to run.
        step_sizes: the α that are tried together, none above 1.
        sufficient_decrease: the fraction of the expected decrease that an accepted step must reach.
        tolerance: converged once an iteration lowers the cost, or expects to, by no more than this fraction of it.
        regularization: the first μ. Too small a one lets the first step leap into a poor local minimum. Convergence is
            not judged above it, where steps are short by force.
        regularization_min: the smallest μ other than zero.
        regularization_max: the solver gives up above this μ.
        regularization_factor: Δ_0, by which the growth rate of μ rises at each failure and falls at each success.
    """

    iterations: int = 50
    step_sizes: tuple[float, ...] = (1.0, 0.5, 0.2, 0.05)
    sufficient_decrease: float = 1e-3
    tolerance: float = 1e-5
    regularization: float = 1.0
    regularization_min: float = 1e-6
    regularization_max: float = 1e8
    regularization_factor: float = 1.6


class _Policy(NamedTuple):
    """Affine policy u = ū + α k + K (x - x̄), expected to change the cost by α ΔV[0] + α² ΔV[1]."""

    k: jax.Array  # [T, m]
    K: jax.Array  # [T, m, n]
    change: jax.Array  # ΔV, [2]


class _Search(NamedTuple):
    """What one iteration hands to the next; `policy` belongs to the plan and is the next one to roll out."""

    states: jax.Array
    actions: jax.Array
    cost: jax.Array
    policy: _Policy
    mu: jax.Array
    delta: jax.Array  # growth rate of mu
    iterations: jax.Array
    converged: jax.Array


def _backward(problem: Problem, states: jax.Array, actions: jax.Array, mu: jax.Array) -> _Policy:
    """Improves a plan's policy by the recursion at the head of this file, from the last step to the first.

    Where the linear model is not finite, k and K are zero and ΔV is NaN, so that no line search can succeed.
    """
    n, m = states.shape[-1], actions.shape[-1]

    dynamics = problem.approximation or problem.dynamics

    def stage(x, u, t):
        return dynamics(x, u), problem.running_residual(x, u, t)

    ((A, B), (r_x, r_u)), (_, r) = linearize(stage, states[:-1], actions, jnp.arange(len(actions), dtype=jnp.int32))
    r_T, r_Tx = problem.terminal_residual(states[-1]), jax.jacfwd(problem.terminal_residual)(states[-1])

    def step(carry, inputs):
        V_x0, V_x, V_xx, k_next = carry
        u, r, A, B, r_x, r_u = inputs
        V_reg = V_xx + mu * jnp.eye(n, dtype=V_xx.dtype)
        Q_u = r_u.T @ r + B.T @ V_x
        Q_uu = r_u.T @ r_u + B.T @ V_reg @ B
        Q_ux = r_u.T @ r_x + B.T @ V_reg @ A
        k, free = boxqp.solve(Q_uu, Q_u, problem.control_low - u, problem.control_high - u, start=k_next)
        K = -solve_free(Q_uu, Q_ux, free)
        F, S = A + B @ K, r_x + r_u @ K
        Bk, r_uk = B @ k, r_u @ k
        # V_x is that of the full step. Its part at α = 0 makes the expected change exact for every α, whatever μ is.
        linear = k @ (r_u.T @ r + B.T @ V_x0)
        total = k @ Q_u + 0.5 * (r_uk @ r_uk + Bk @ V_xx @ Bk)
        V_x0, V_x = S.T @ r + F.T @ V_x0, S.T @ (r + r_uk) + F.T @ (V_x + V_xx @ Bk)
        V_xx = S.T @ S + F.T @ V_xx @ F
        return (V_x0, V_x, 0.5 * (V_xx + V_xx.T), k), _Policy(k, K, jnp.stack([linear, total - linear]))

    last = r_Tx.T @ r_T, r_Tx.T @ r_T, r_Tx.T @ r_Tx, jnp.zeros(m, actions.dtype)
    _, (k, K, changes) = lax.scan(step, last, (actions, r, A, B, r_x, r_u), reverse=True)
    change = changes.sum(0)
    finite = jnp.isfinite(k).all() & jnp.isfinite(K).all() & jnp.isfinite(change).all()
    return _Policy(jnp.where(finite, k, 0.0), jnp.where(finite, K, 0.0), jnp.where(finite, change, jnp.nan))


def _forward(
    problem: Problem, states: jax.Array, actions: jax.Array, policy: _Policy, alpha: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Rolls the policy out with step size alpha; returns its states, its actions and J."""

    def step(x, inputs):
        t, x_bar, u_bar, k, K = inputs
        u = jnp.clip(u_bar + alpha * k + K @ (x - x_bar), problem.control_low, problem.control_high)
        r = problem.running_residual(x, u, t)
        return problem.dynamics(x, u), (x, u, 0.5 * r @ r)

    inputs = jnp.arange(len(actions), dtype=jnp.int32), states[:-1], actions, policy.k, policy.K
    last, (new_states, new_actions, costs) = lax.scan(step, states[0], inputs)
    r_T = problem.terminal_residual(last)
    return jnp.concatenate([new_states, last[None]]), new_actions, costs.sum() + 0.5 * r_T @ r_T


def _schedule(mu: jax.Array, delta: jax.Array, success: jax.Array, options: Options) -> tuple[jax.Array, jax.Array]:
    """Updates mu by the quadratic schedule of Tassa et al. 2012, ever faster in a run of equal outcomes."""
    factor, least = options.regularization_factor, options.regularization_min
    delta = jnp.where(success, jnp.minimum(1 / factor, delta / factor), jnp.maximum(factor, delta * factor))
    mu = mu * delta
    return jnp.where(success, jnp.where(mu < least, 0.0, mu), jnp.maximum(mu, least)), delta


def solve(problem: Problem, initial_state: jax.Array, actions: jax.Array, options: Options | None = None) -> Plan:
    """Plans from an initial state, beginning with a guess of the actions.

    The cost never rises from one iteration to the next, and only finite rollouts are accepted. Pure and jittable;
    under `jax.vmap` the problems that have finished wait, unchanged, for the others. Everything is computed in the
    data type of `initial_state`.

    Args:
        problem: what to solve. Its functions may close over traced arrays, such as the parameters of a task.
        initial_state: x_0, [n].
        actions: the first ū, [T, m]; moved into the limits.
        options: settings; `Options()` by default.
    """
    options = options or Options()
    dtype = initial_state.dtype
    (T, m), n = actions.shape, len(initial_state)
    alphas = jnp.asarray(options.step_sizes, dtype)
    forward = jax.vmap(_forward, in_axes=(None, None, None, None, 0))

    def iterate(search: _Search) -> _Search:
        candidates = forward(problem, search.states, search.actions, search.policy, alphas)
        states, _, costs = candidates
        expected = -(alphas * search.policy.change[0] + alphas**2 * search.policy.change[1])
        sufficient = search.cost - costs > options.sufficient_decrease * jnp.maximum(expected, 0.0)
        # NaN costs fail the comparison. The last state has to be looked at: no action and maybe no residual follows it.
        accepted = sufficient & jnp.isfinite(states).all((1, 2))
        best = jnp.argmin(jnp.where(accepted, costs, jnp.inf))
        success = accepted[best]
        current = search.states, search.actions, search.cost
        states, actions, cost = jax.tree.map(lambda new, old: jnp.where(success, new[best], old), candidates, current)

        mu, delta = _schedule(search.mu, search.delta, success, options)
        policy = _backward(problem, states, actions, mu)
        negligible = options.tolerance * cost
        done = (success & (search.cost - cost <= negligible)) | (-policy.change.sum() <= negligible)
        converged = done & (mu <= options.regularization) & jnp.isfinite(cost)
        return _Search(states, actions, cost, policy, mu, delta, search.iterations + 1, converged)

    def unfinished(search: _Search) -> jax.Array:
        return ~search.converged & (search.iterations < options.iterations) & (search.mu <= options.regularization_max)

    # Pass 0 of the loop, not counted, rolls out the initial actions and finds their policy. So the dynamics, slow to
    # compile, appear only twice in the program. As pass 0 counts as a success, μ starts one factor higher.
    low, high = problem.control_low, problem.control_high
    start = _Search(
        states=jnp.broadcast_to(initial_state, (T + 1, n)),
        actions=jnp.clip(actions.astype(dtype), low, high),
        cost=jnp.asarray(jnp.inf, dtype),
        policy=_Policy(jnp.zeros((T, m), dtype), jnp.zeros((T, m, n), dtype), jnp.zeros(2, dtype)),
        mu=jnp.asarray(options.regularization * options.regularization_factor, dtype),
        delta=jnp.ones((), dtype),
        iterations=jnp.asarray(-1, jnp.int32),
        converged=jnp.asarray(False),
    )
    end = lax.while_loop(unfinished, iterate, start)
    return Plan(end.states, end.actions, end.policy.K, end.cost, end.iterations, end.converged)
