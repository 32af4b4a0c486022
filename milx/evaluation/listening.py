"""Whether a policy listens to the demonstration: errors of its actions with the right one, another one and none.

The loss after the inner step falls far below the loss before it even where nothing of the task is transferred: any
demonstration tells how actions are distributed. What tells whether a policy listens is the difference between its own
task's demonstration and another task's.
"""

import functools

import jax
import jax.numpy as jnp

from milx.core import parallel, pytrees
from milx.core.batching import map_in_groups
from milx.evaluation.replay import replay
from milx.methods.base import Method
from milx.methods.whitening import MIN_STD
from milx.types import Demo, Params, TaskBatch, TaskParams

MARGIN = 0.05
"""A policy listens if another task's demonstration makes its error larger by more than this fraction."""
ERRORS = {"own_demo": "its own", "other_demo": "another task's", "no_demo": "no"}
"""The errors that `measure` finds, by whose demonstration the policy saw."""
_SMALLEST = 1e-3


def measure(method: Method, params: Params, batch: TaskBatch, most: int | None = None) -> dict[str, jax.Array]:
    """Measures errors of the actions on the queries of N tasks, and the size of the step, inside `jax.jit`.

    Errors are squared, and divided by the variance of the queries' actions (entry by entry, at least MIN_STD squared,
    then averaged): 1 is what the best constant action has. On reach_state, which has three tasks, the other task is the
    same in a third of cases.

    Args:
        method: what adapts and acts.
        params: what it has learned.
        batch: N tasks, of which neighbors should differ.
        most: maximum number of tasks that a device adapts to at once; all if None.

    Returns:
        "own_demo", "other_demo" (with two tasks or more) and, where a policy can act without a demonstration,
        "no_demo": the errors after adaptation to the task's demonstration, to that of the next task in the batch, and
        before. There, too, "step/<name>" for every tensor of the policy: the root mean square of its change, divided by
        that of the tensor (or by 1e-3 where that is smaller), averaged over the tasks.
    """
    most = most or len(batch.query.action)

    def adapt(params: Params, support: Demo) -> TaskParams:
        return map_in_groups(functools.partial(method.predictor.adapt, params), (support,), most)

    adapted = parallel.shard_tasks(adapt, shared=1)(params, batch.support)
    return compare(method, params, adapted, batch.query, most)


def compare(method: Method, params: Params, adapted: TaskParams, query: Demo, most: int) -> dict[str, jax.Array]:
    """Measures what `measure` does on policies `adapted` to the demonstrations of N tasks, [N, ...], in `jax.jit`."""
    of_next = jax.tree.map(lambda x: jnp.roll(x, -1, axis=0), adapted)
    count, prior = len(query.action), method.unadapted(params)
    policies = {"own_demo": adapted} | ({"other_demo": of_next} if count > 1 else {})
    if prior is not None:
        policies["no_demo"] = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), prior)

    def error(task_params: TaskParams, query: Demo) -> jax.Array:
        return map_in_groups(functools.partial(_squared_error, method), (task_params, query), min(most, count))

    # In one call: one copy of the network in the program instead of three.
    every = jax.tree.map(lambda *xs: jnp.concatenate(xs), *policies.values())
    asked = jax.tree.map(lambda x: jnp.concatenate([x] * len(policies)), query)
    errors = parallel.shard_tasks(error)(every, asked).reshape(len(policies), count, -1)
    action = query.action
    variance = jnp.maximum(jnp.var(action.reshape(-1, action.shape[-1]), axis=0), MIN_STD**2)
    found = dict(zip(policies, (errors.mean(axis=1) / variance).mean(axis=-1), strict=True))
    return found if prior is None else found | _steps(prior, adapted)


def is_deaf(found: dict[str, float]) -> bool:
    """Tells whether the errors of `measure` say that the demonstration makes no difference."""
    return "other_demo" in found and found["other_demo"] <= (1 + MARGIN) * found["own_demo"]


def advice(has_inner_step: bool) -> str:
    """Says what to try when a run does not listen."""
    remedies = "more tasks in a meta-batch (train.meta_batch), or whitened actions (method.whiten_actions)"
    if has_inner_step:
        remedies = f"imitation first (method.imitation_steps), another method.inner_lr, {remedies}"
    return f"the policy does not listen: another task's demonstration does as well as its own. Try {remedies}"


def warning(found: dict[str, float], step: int, steps: int, method: Method) -> str | None:
    """Says what to try if a run does not listen after a fifth of its meta-updates; None otherwise.

    Args:
        found: errors of `measure`.
        step: meta-updates so far; the method's `imitation_steps`, which come first, do not count.
        steps: meta-updates in all, with those.
        method: what learns.
    """
    done, total = step - method.imitation_steps, steps - method.imitation_steps
    # What has an inner step, and nothing else, can act before it.
    return advice(has_inner_step="no_demo" in found) if 5 * done >= total and is_deaf(found) else None


def in_words(found: dict[str, float]) -> str:
    """Puts the errors of `measure` into words, to follow a semicolon."""
    parts = [f"{found[name]:.2f} with {words}" for name, words in ERRORS.items() if name in found]
    return f"; error of the actions {', '.join(parts)} demonstration" if parts else ""


def _squared_error(method: Method, task_params: TaskParams, query: Demo) -> jax.Array:
    """Averages squared errors over the time steps of demonstrations [Q, T, ...]: [A]."""
    action = jax.vmap(functools.partial(replay, method, task_params))(query)
    return jnp.square(action - query.action).mean(axis=(0, 1))


def _steps(before: Params, after: Params) -> dict[str, jax.Array]:
    def size(x: jax.Array) -> jax.Array:
        return jnp.sqrt(jnp.square(x).mean())

    moved = jax.tree.map(lambda x, y: jax.vmap(lambda y: size(y - x))(y).mean(), before, after)
    tensors, changes = pytrees.leaves(before), pytrees.leaves(moved)
    learned = {name: x for name, x in tensors.items() if x.size and not name.startswith("whitening.")}
    return {f"step/{name}": changes[name] / jnp.maximum(size(x), _SMALLEST) for name, x in learned.items()}
