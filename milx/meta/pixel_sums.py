"""Sums over all pixels of all images, for each channel, by a kernel of a GPU, whose few sums XLA adds.

XLA sums over many rows of few numbers at about half of the GPU's bandwidth or less.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jax.interpreters import ad, batching

from milx.meta.operations import MOST_NUMBERS, MOST_TASKS, PROGRAMS, check_numbers, operation

_AT_ONCE = 8192
"""Numbers that a program adds at once."""


def sum_over_pixels(x: jax.Array, interpret: bool = False) -> jax.Array:
    """Sums [B, .., F] to [F], in float32, or in float64 if x is.

    Args:
        x: images.
        interpret: run the kernel on any device, slowly, for tests.

    Raises:
        ValueError: for more numbers in the images of a task than 32 bits count.
    """
    return _sum.bind(x.reshape(1, -1, x.shape[-1]), interpret=interpret)[0]


def _sum_rows(x: jax.Array, *, interpret: bool) -> jax.Array:
    """Sums [T, N, F] to [T, F]."""
    tasks, count, channels = x.shape
    columns = pl.next_power_of_2(channels)
    rows = max(1, _AT_ONCE // columns)
    steps = pl.cdiv(count, rows)
    parts = min(steps, pl.cdiv(PROGRAMS, tasks))
    steps = pl.cdiv(steps, parts)
    wide = jnp.promote_types(x.dtype, jnp.float32)
    check_numbers("sum_over_pixels", x.shape)

    def program(x: Any, sums: Any) -> None:
        part, task = pl.program_id(0), pl.program_id(1)
        row, column = jnp.arange(rows, dtype=jnp.int32)[:, None], jnp.arange(columns, dtype=jnp.int32)[None]

        def add(step: jax.Array, total: jax.Array) -> jax.Array:
            at = (part * steps + step) * rows + row
            inside = (at < count) & (column < channels)
            return total + triton.load(x.at[task, at * channels + column], mask=inside, other=0).astype(wide)

        total = lax.fori_loop(0, steps, add, jnp.zeros((rows, columns), wide)).sum(axis=0)
        triton.store(sums.at[part, task, column[0]], total, mask=column[0] < channels)

    call = pl.pallas_call(
        program,
        out_shape=jax.ShapeDtypeStruct((parts, tasks, channels), wide),
        grid=(parts, tasks),
        compiler_params=triton.CompilerParams(num_warps=4, num_stages=1),
        interpret=interpret,
        name="sum_over_pixels",
    )
    return call(x.reshape(tasks, -1)).sum(axis=0)


def _sum_plainly(x: jax.Array) -> jax.Array:
    """Sums [T, N, F] to [T, F] on any device."""
    return x.sum(axis=1, dtype=jnp.promote_types(x.dtype, jnp.float32))


_sum = operation(_sum_rows, _sum_plainly)


def _spread(sums: jax.Array, x: Any, **_: Any) -> list[jax.Array]:
    """Gives every number of x the gradient by its sum."""
    return [jnp.broadcast_to(sums[:, None], x.aval.shape).astype(x.aval.dtype)]


def _map(args: tuple[jax.Array], axes: tuple[int], **settings: Any) -> tuple[jax.Array, int]:
    """Maps over further tasks: the axis that is mapped joins that of the tasks.

    If there are too many of them, or of their numbers, one is computed after the other.
    """
    x = jnp.moveaxis(args[0], axes[0], 0)
    if x.size > MOST_NUMBERS or x.shape[0] * x.shape[1] > MOST_TASKS:
        return jax.lax.map(lambda each: _sum.bind(each, **settings), x), 0
    found = _sum.bind(x.reshape(-1, *x.shape[2:]), **settings)
    return found.reshape(*x.shape[:2], -1), 0


ad.deflinear2(_sum, _spread)
batching.primitive_batchers[_sum] = _map
