"""Problems in other controls than the actions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.trajopt.episode import with_controls
from milx.trajopt.ilqr import Problem


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def test_a_problem_in_other_controls_costs_what_its_actions_cost():
    gain = jnp.array([[2.0], [-1.0]])
    problem = Problem(
        dynamics=lambda x, u: x + u,
        running_residual=lambda x, u, t: jnp.concatenate([x, u * t]),
        terminal_residual=lambda x: 3.0 * x,
        control_low=jnp.full(2, -1.0),
        control_high=jnp.full(2, 1.0),
        approximation=lambda x, u: x + 0.9 * u,
    )
    changed = with_controls(problem, lambda x, v: gain @ v - 0.1 * x, jnp.array([-2.0]), jnp.array([2.0]))
    x, v, t = jnp.array([0.5, -0.3]), jnp.array([0.8]), jnp.asarray(2)
    u = jnp.array([1.0, -0.77])  # 1.55 is clipped
    np.testing.assert_allclose(changed.dynamics(x, v), x + u, atol=1e-12)
    np.testing.assert_allclose(changed.approximation(x, v), x + 0.9 * u, atol=1e-12)
    np.testing.assert_allclose(changed.running_residual(x, v, t), jnp.concatenate([x, 2 * u]), atol=1e-12)
    np.testing.assert_allclose(changed.terminal_residual(x), 3 * x, atol=1e-12)
