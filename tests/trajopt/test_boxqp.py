"""The box-constrained quadratic program, against SciPy."""

import functools

import jax
import numpy as np
import pytest
import scipy.optimize

from milx.trajopt import boxqp


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize("m", [1, 2, 7])
def test_box_qp_reaches_the_optimum(m):
    rng = np.random.default_rng(m)
    L = np.tril(rng.standard_normal((50, m, m))) + 2 * np.eye(m)
    H, g = L @ L.transpose(0, 2, 1), 5 * rng.standard_normal((50, m))
    low, high = -rng.uniform(0, 1, (50, m)), rng.uniform(0, 1, (50, m))
    solve = jax.jit(jax.vmap(functools.partial(boxqp.solve, iterations=20)))
    found, free = solve(H, g, low, high, np.zeros_like(g))
    for i in range(50):
        # ½ xᵀHx + gᵀx is ½ |Lᵀx + L⁻¹g|² up to a constant.
        best = scipy.optimize.lsq_linear(L[i].T, -np.linalg.solve(L[i], g[i]), (low[i], high[i]), method="bvls")
        np.testing.assert_allclose(found[i], best.x, atol=1e-7)
        np.testing.assert_array_equal(free[i], best.active_mask == 0)
