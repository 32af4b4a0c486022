"""Mapping a function over more inputs than fit on a device at once: by several calls, or inside `jax.jit`."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from milx.core import parallel, progress


def map_in_chunks(
    function: Callable[..., Any], inputs: tuple, size: int, counted: bool = True, rows: np.ndarray | None = None
) -> Any:
    """Calls `function(*inputs)` on slices of the leading axis and joins the results.

    All calls have the same size, so the function is compiled only once. The last slice is filled up by repeating the
    last entry.

    The inputs of every call are complete on every device (`milx.core.parallel.replicate`).

    Args:
        function: maps pytrees with leading axis [size] to a pytree with leading axis [size].
        inputs: pytrees with leading axis [M].
        size: number of entries in one call. It is rounded up to a multiple of the number of devices.
        counted: whether the entries count as done in `milx.core.progress` after each call.
        rows: [R] which entries to map, in this order; None for all.

    Returns:
        The results, with leading axis [M] or [R].
    """
    rows = np.arange(len(jax.tree.leaves(inputs)[0])) if rows is None else rows
    total, size = len(rows), parallel.round_up(size)
    results = []
    for start in range(0, total, size):
        index = rows[np.minimum(np.arange(start, start + size), total - 1)]
        results.append(jax.block_until_ready(function(*parallel.replicate(_take(inputs, index)))))
        if counted:
            progress.advance(size)
    return _join(results, total)


# One program each, instead of one for every shape and operation.
@jax.jit
def _take(inputs: tuple, index: np.ndarray) -> tuple:
    return jax.tree.map(lambda x: x[index], inputs)


@functools.partial(jax.jit, static_argnums=1)
def _join(results: list[Any], total: int) -> Any:
    return jax.tree.map(lambda *xs: jnp.concatenate(xs)[:total], *results)


def in_groups(inputs: Any, most: int) -> Any:
    """Reshapes a pytree with a leading axis [N] to equal groups, [N / size, size, ...].

    Args:
        inputs: what is grouped.
        most: maximum size of a group. The size is the largest divisor of N that is at most `most`, so the groups have
            size 1 if N is a prime number greater than `most`.
    """
    total = len(jax.tree.leaves(inputs)[0])
    size = max(size for size in range(1, total + 1) if total % size == 0 and size <= max(most, 1))
    # All sizes are explicit, because they cannot be inferred for arrays without entries.
    return jax.tree.map(lambda x: jnp.reshape(x, (total // size, size, *jnp.shape(x)[1:])), inputs)


def map_in_groups(function: Callable[..., Any], inputs: tuple, most: int) -> Any:
    """Computes `jax.vmap(function)(*inputs)` in the groups of `in_groups`, one after the other, inside `jax.jit`.

    Args:
        function: maps pytrees to a pytree.
        inputs: the function's inputs, with a leading axis [N].
        most: maximum size of a group.

    Returns:
        The results, with leading axis [N].
    """
    groups = in_groups(inputs, most)
    count, size = jax.tree.leaves(groups)[0].shape[:2]
    if count == 1:
        return jax.vmap(function)(*inputs)
    # Not by jax.lax.map(batch_size=...), which fails on arrays without entries.
    found = jax.lax.map(lambda group: jax.vmap(function)(*group), groups)
    return jax.tree.map(lambda x: x.reshape(count * size, *x.shape[2:]), found)
