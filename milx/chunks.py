"""Mapping a jitted function over more inputs than fit on the device at once."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from milx import parallel


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
