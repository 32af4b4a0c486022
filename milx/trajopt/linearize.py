"""First-order models along a trajectory, by forward-mode differentiation."""

from collections.abc import Callable
from typing import Any

import jax


def linearize(
    function: Callable[..., Any], states: jax.Array, actions: jax.Array, *per_step: jax.Array
) -> tuple[Any, Any]:
    """Computes Jacobians and values of `function(x, u, ...)` at every step of a trajectory.

    T is the number of steps, n the size of a state, m of an action. One pass pushes all n + m unit tangents through
    the function together. Forward mode is the only way through `mjx.step`, whose solver loops have no reverse mode.

    Args:
        function: maps x [n], u [m] and one element of each of `per_step` to a pytree of vectors.
        states: [T, n].
        actions: [T, m].
        *per_step: further arguments, [T, ...] each, by which the function is not differentiated.

    Returns:
        The pytree of the function with each vector [k] replaced by a pair of Jacobians, by the state [T, k, n] and by
        the action [T, k, m]; and the pytree of the values, [T, k].
    """
    jacobians = jax.jacfwd(lambda *inputs: (function(*inputs),) * 2, argnums=(0, 1), has_aux=True)
    return jax.vmap(jacobians)(states, actions, *per_step)
