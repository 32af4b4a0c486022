"""Mapping a function over more inputs than a device should work on at once: by calls, and inside a jitted one."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from milx.core import parallel


def map_in_chunks(function: Callable[..., Any], inputs: tuple, size: int) -> Any:
    """Calls `function(*inputs)` on slices of the leading axis and joins the results.

    Every call has the same size, so that one compilation serves all: where entries lack, the last one is repeated.

    Args:
        function: maps pytrees with leading axis [size] to a pytree with leading axis [size].
        inputs: pytrees with leading axis [M].
        size: the most entries of one call, but for rounding up to a multiple of the number of devices.

    Returns:
        The results, with leading axis [M].
    """
    total, size = len(jax.tree.leaves(inputs)[0]), parallel.round_up(size)
    results = []
    for start in range(0, total, size):
        index = jnp.minimum(jnp.arange(start, start + size), total - 1)
        result = function(*jax.tree.map(lambda x, index=index: x[index], inputs))
        results.append(jax.tree.map(lambda x, start=start: x[: total - start], result))
    return jax.tree.map(lambda *xs: jnp.concatenate(xs), *results)


def map_in_groups(function: Callable[..., Any], inputs: tuple, most: int) -> Any:
    """`jax.vmap(function)(*inputs)` in equal groups, one after the other; to be called inside `jax.jit`.

    Args:
        function: maps pytrees to a pytree.
        inputs: the same with a leading axis [N].
        most: of the entries of a group. Groups are N's largest divisor up to it, so a prime number goes one by one.
    """
    total = len(jax.tree.leaves(inputs)[0])
    size = max(size for size in range(1, total + 1) if total % size == 0 and size <= max(most, 1))
    if size == total:
        return jax.vmap(function)(*inputs)
    # By sizes that are said, as leaves without entries do not tell: jax.lax.map(batch_size=...) stumbles over them.
    groups = jax.tree.map(lambda x: x.reshape(total // size, size, *x.shape[1:]), inputs)
    found = jax.lax.map(lambda group: jax.vmap(function)(*group), groups)
    return jax.tree.map(lambda x: x.reshape(total, *x.shape[2:]), found)
