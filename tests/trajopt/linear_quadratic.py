"""Linear dynamics and quadratic costs, for which every quantity has an independent answer."""

import jax.numpy as jnp
import numpy as np
import scipy.optimize

from milx.trajopt import ilqr


def random_lq(seed, T=15, n=4, m=2):
    """Samples a linear system, stable so that limits leave it controllable, that has to follow a random reference."""
    rng = np.random.default_rng(seed)
    A = np.eye(n) + 0.3 * rng.standard_normal((n, n))
    return {
        "A": 0.95 * A / np.abs(np.linalg.eigvals(A)).max(),
        "B": rng.standard_normal((n, m)),
        "S": rng.standard_normal((n, n)),
        "R": np.eye(m) + 0.1 * rng.standard_normal((m, m)),
        "reference": rng.standard_normal((T, n)),
        "S_T": 2.0 * rng.standard_normal((n, n)),
        "x_0": 2.0 * rng.standard_normal(n),
        "guess": rng.standard_normal((T, m)),
    }


def lq_problem(lq, limit):
    lq = {name: jnp.asarray(value) for name, value in lq.items()}
    return ilqr.Problem(
        dynamics=lambda x, u: lq["A"] @ x + lq["B"] @ u,
        running_residual=lambda x, u, t: jnp.concatenate([lq["S"] @ (x - lq["reference"][t]), lq["R"] @ u]),
        terminal_residual=lambda x: lq["S_T"] @ x,
        control_low=jnp.full(lq["B"].shape[1], -limit),
        control_high=jnp.full(lq["B"].shape[1], limit),
    )


def cost(lq, actions, x=None, now=0):
    """Adds up J in a loop, from step `now` on if the state x at that step is given."""
    x, total = lq["x_0"] if x is None else x, 0.0
    for u, reference in zip(actions, lq["reference"][now:], strict=True):
        total += 0.5 * np.sum((lq["S"] @ (x - reference)) ** 2) + 0.5 * np.sum((lq["R"] @ u) ** 2)
        x = lq["A"] @ x + lq["B"] @ u
    return total + 0.5 * np.sum((lq["S_T"] @ x) ** 2)


def riccati(lq):
    """Solves the discrete Riccati recursion of the tracking problem: states, actions and gains."""
    A, B, R, Q = lq["A"], lq["B"], lq["R"].T @ lq["R"], lq["S"].T @ lq["S"]
    P, p = lq["S_T"].T @ lq["S_T"], np.zeros(len(A))
    K, k = [], []
    for reference in lq["reference"][::-1]:
        K.insert(0, -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A))
        k.insert(0, -np.linalg.solve(R + B.T @ P @ B, B.T @ p))
        F = A + B @ K[0]
        P, p = Q + A.T @ P @ F, F.T @ p - Q @ reference
    states, actions = [lq["x_0"]], []
    for K_t, k_t in zip(K, k, strict=True):
        actions.append(K_t @ states[-1] + k_t)
        states.append(A @ states[-1] + B @ actions[-1])
    return np.stack(states), np.stack(actions), np.stack(K)


def bounded_least_squares(lq, limit):
    """Computes the optimal actions under limits by SciPy: the problem's residuals are M u + c in the actions."""
    T, m = lq["guess"].shape

    def residuals(actions):
        x, parts = lq["x_0"], []
        for u, reference in zip(actions.reshape(T, m), lq["reference"], strict=True):
            parts += [lq["S"] @ (x - reference), lq["R"] @ u]
            x = lq["A"] @ x + lq["B"] @ u
        return np.concatenate([*parts, lq["S_T"] @ x])

    c = residuals(np.zeros(T * m))
    M = np.stack([residuals(e) - c for e in np.eye(T * m)], axis=1)
    solution = scipy.optimize.lsq_linear(M, -c, (-limit, limit), method="bvls", tol=1e-14)
    assert solution.success
    gradient = (M.T @ (M @ solution.x + c)).reshape(T, m)
    return solution.x.reshape(T, m), solution.cost, gradient
