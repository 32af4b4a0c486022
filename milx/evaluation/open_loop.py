"""How good a policy is where there is no simulator: its actions on recorded observations of held-out tasks."""

import functools

import jax
import jax.numpy as jnp

from milx.data.recorded import Recorded
from milx.evaluation.replay import replay
from milx.methods import Method
from milx.types import Demo, Params, TaskParams


@functools.partial(jax.jit, static_argnums=(0, 1))
def task_errors(
    method: Method,
    shots: int,
    params: Params,
    queries: Recorded,
    support: Demo,
    other: Demo | None,
    mean: jax.Array,
    scale: jax.Array,
) -> dict[str, jax.Array]:
    """Computes mean squared errors of the actions on a task's queries, in units of `scale`.

    Args:
        method: what adapts and acts.
        shots: K.
        params: what it has learned.
        queries: [D, T, ...] demonstrations to predict the actions of, as the method's `predictor` sees them.
        support: [K, T, ...] demonstrations to adapt to, likewise.
        other: demonstrations of another task; None for none.
        mean: [A] the training tasks' mean action.
        scale: [A] their standard deviation.

    Returns:
        "after" adaptation; "before", if the method can act without; after adaptation to the "other_task"; and of the
        "mean_action".
    """
    method = method.predictor
    weight = queries.acts / queries.acts.sum()

    def error(action: jax.Array) -> jax.Array:
        return (jnp.square((action - queries.demo.action) / scale).mean(axis=(1, 2)) * weight).sum()

    def act(task_params: TaskParams) -> jax.Array:
        return jax.lax.map(functools.partial(replay, method, task_params), queries.demo)

    errors = {"after": error(act(method.adapt(params, support))), "mean_action": error(mean)}
    if (prior := method.unadapted(params)) is not None:
        errors["before"] = error(act(prior))
    if other is not None:
        errors["other_task"] = error(act(method.adapt(params, other)))
    return errors
