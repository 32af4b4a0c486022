"""What is minimized over tasks, and its gradient within a bound on memory."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from milx.core.batching import in_groups


def multi_step_loss(losses: jax.Array, progress: jax.Array | float) -> jax.Array:
    """Weighs the losses [K] after each of K inner steps: sum over k of w_k L_k (Antoniou et al. 2019, Section 4).

    With the progress p of training, from 0 to 1, w_k = (1 - p) / K for k < K, and w_K is what they leave of 1: first
    all steps count alike, and at the end the last one alone.
    """
    weight = (1 - progress) / len(losses)
    return weight * losses[:-1].sum() + (1 - weight * (len(losses) - 1)) * losses[-1]


def meta_gradient(
    task_loss: Callable[[Any, Any], Any], params: Any, tasks: Any, at_once: int | None = None, has_aux: bool = False
) -> tuple[Any, Any]:
    """Computes the gradient of the mean over tasks of task_loss(params, task).

    Args:
        task_loss: the loss of one task, a scalar, in which `adapt` or `implicit_adapt` may be called; with `has_aux` a
            pair of it and a pytree of arrays.
        params: what it is differentiated by.
        tasks: N of them, a pytree whose leaves have this leading axis.
        at_once: how many tasks are worked on at the same time, at most, which bounds memory; None for all. The number
            is the largest divisor of N that is not larger. `tasks_within` finds one for a bound in bytes.
        has_aux: whether `task_loss` tells more of a task than its loss, as in `jax.grad`.

    Returns:
        The gradient, as `params`, and the losses [N]; with `has_aux` the gradient, and a pair of the losses and what
        tasks told beside them, whose leaves have the leading axis [N].

    Raises:
        ValueError: if there is no task, or the leaves have several leading axes; if no task is to be worked on at once;
            if a task's loss is no scalar, or with `has_aux` no pair is returned.
    """
    count = _count(tasks)
    if at_once is not None and at_once < 1:
        raise ValueError(f"at_once: got {at_once}, expected at least 1, or None")

    def of_group(tasks: Any) -> tuple[Any, tuple[jax.Array, Any]]:
        def mean_loss(params: Any) -> tuple[jax.Array, tuple[jax.Array, Any]]:
            found = jax.vmap(task_loss)(for_each_task(params, _count(tasks)), tasks)
            if has_aux and not (isinstance(found, tuple) and len(found) == 2):
                raise ValueError("task_loss: got no pair, expected one with has_aux")
            losses, aux = found if has_aux else (found, None)
            if not isinstance(losses, jax.Array) or losses.ndim != 1:
                got = jax.tree.map(lambda x: jnp.shape(x)[1:], losses)
                raise ValueError(f"task_loss: got what has the shape {got}, expected a scalar")
            return losses.mean(), (losses, aux)

        return jax.grad(mean_loss, has_aux=True)(params)

    if at_once is None or at_once >= count:
        mean, found = of_group(tasks)
        return mean, found if has_aux else found[0]

    def add(total: Any, group: Any) -> tuple[Any, tuple[jax.Array, Any]]:
        gradient, found = of_group(group)
        return jax.tree.map(lambda total, x: total + x.astype(total.dtype), total, gradient), found

    params = jax.tree.map(jnp.asarray, params)
    zeros = jax.tree.map(lambda p: jnp.zeros(p.shape, jnp.promote_types(p.dtype, jnp.float32)), params)
    total, found = jax.lax.scan(add, zeros, in_groups(tasks, at_once))
    mean = jax.tree.map(lambda x, p: (x / len(found[0])).astype(p.dtype), total, params)
    found = jax.tree.map(lambda x: x.reshape(count, *x.shape[2:]), found)
    return mean, found if has_aux else found[0]


def for_each_task(params: Any, count: int) -> Any:
    """Gives each of N tasks its own copy of the parameters, with a leading axis [N].

    Then all gradients by one parameter are added for each task before they are summed over the tasks, once, which takes
    memory for one gradient of each task. Where tasks share the parameters, each of these gradients is summed over them
    on its own.
    """
    return jax.tree.map(lambda p: jnp.broadcast_to(p, (count, *jnp.shape(p))), params)


def tasks_within(
    memory: int, task_loss: Callable[[Any, Any], Any], params: Any, tasks: Any, has_aux: bool = False
) -> int:
    """Finds the largest number of tasks on which `meta_gradient` can work at the same time within a bound on memory.

    Compiles the meta-gradient, from shapes alone, for one number of tasks after the other, from all of them down. The
    bound holds for a program that does nothing else.

    Args:
        memory: bytes for what the program needs beside its arguments and its results.
        task_loss: as in `meta_gradient`.
        params: arrays, or their shapes (`jax.ShapeDtypeStruct`).
        tasks: N of them, or their shapes.
        has_aux: as in `meta_gradient`.

    Returns:
        `at_once` for `meta_gradient`, a divisor of N.

    Raises:
        ValueError: if no number fits; the message says what one task at a time needs. Also where `meta_gradient` raises
            one.
    """
    count, shapes = _count(tasks), jax.eval_shape(lambda *x: x, params, tasks)
    needed = 0
    for at_once in (number for number in range(count, 0, -1) if count % number == 0):
        gradient = jax.jit(functools.partial(meta_gradient, task_loss, at_once=at_once, has_aux=has_aux))
        analysis = gradient.lower(*shapes).compile().memory_analysis()
        assert analysis is not None, "CPUs and GPUs tell"
        needed = analysis.temp_size_in_bytes
        if needed <= memory:
            return at_once
    raise ValueError(f"memory: got {memory:,} bytes, expected at least {needed:,}, which one task at a time needs")


def _count(tasks: Any) -> int:
    """Returns how many tasks there are.

    Raises:
        ValueError: if there is none, or if their leaves have several leading axes.
    """
    shapes = {jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(tasks)}
    if len(shapes) != 1 or not (count := sum(next(iter(shapes)))):
        raise ValueError(f"tasks: got the leading axes {sorted(shapes)}, expected one of at least 1")
    return count
