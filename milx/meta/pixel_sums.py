"""Sums over the pixels of an image for each channel, by a kernel of a GPU.

XLA sums over many rows of few numbers at about half of the GPU's bandwidth or less, and writes what several sums need
first. The kernel computes, for images a_0, a_1, .. [N, P, F],

    sum over pixels of k u_1   and   sum over pixels of k (u_1 v_1 + u_2 v_2 + ..)   for each image and channel,

where each pair (u, v) is two of the images, and k is one, or one only where x scale + shift > 0 for one of them, x.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton
from jax.interpreters import ad, batching

from milx.meta.operations import MOST_NUMBERS, PROGRAMS, check_numbers, operation

_AT_ONCE = 4096
"""Numbers of an image that a program reads at once."""
Pairs = tuple[tuple[int, int], ...]
"""Numbers of the images that are multiplied."""


def pixel_sums(
    u: jax.Array, x: jax.Array, gate: tuple[jax.Array, jax.Array] | None = None, interpret: bool = False
) -> tuple[jax.Array, jax.Array]:
    """Sums u, and u x, over the pixels of every image, in float32, or in float64 if they are.

    Args:
        u: images [B, .., F]; it may be x.
        x: images of the same shape and type.
        gate: scale [B] and shift [B, F], to sum only where x scale + shift > 0; what depends on where that is, is
            constant for derivatives.
        interpret: run the kernel on any device, slowly, for tests.

    Returns:
        Both sums, [B, F] each.

    Raises:
        ValueError: for other shapes or types, and for more numbers than 32 bits count.
    """
    if (u.shape, u.dtype) != (x.shape, x.dtype):
        raise ValueError(f"u: got {u.dtype}{list(u.shape)}, expected {x.dtype}{list(x.shape)}, as x")
    expected = (len(x),), (len(x), x.shape[-1])
    if gate is not None and (gate[0].shape, gate[1].shape) != expected:
        raise ValueError(
            f"gate: got shapes {gate[0].shape} and {gate[1].shape}, expected {expected[0]} and {expected[1]}"
        )
    images, pair = ((x,), (0, 0)) if u is x else ((u, x), (0, 1))
    rows = (image.reshape(len(image), -1, image.shape[-1]) for image in images)
    settings = {"pairs": (pair,), "gate": None if gate is None else pair[1], "interpret": interpret}
    found = _sums.bind(*rows, *(gate or ()), **settings)
    return found[:, 0], found[:, 1]


def scale_and_shift(x: jax.Array, scale: jax.Array, shift: jax.Array) -> jax.Array:
    """Computes x scale + shift for images [B, .., F], scale [B] and shift [B, F]."""
    between = (1,) * (x.ndim - 2)
    return x * scale.reshape(-1, *between, 1) + shift.reshape(len(shift), *between, -1)


def _sum_pixels(*arrays: jax.Array, pairs: Pairs, gate: int | None, interpret: bool) -> jax.Array:
    """Computes both sums, [N, 2, F].

    Args:
        arrays: images [N, P, F]; with a gate the scale [N] and the shift [N, F] follow them.
        pairs: which images are multiplied, by their numbers.
        gate: which of them is x; None for none.
        interpret: run on any device, slowly, for tests.
    """
    count, pixels, channels = arrays[0].shape
    columns = pl.next_power_of_2(channels)
    rows = max(1, _AT_ONCE // columns)
    every = pl.cdiv(pixels, rows)
    steps = pl.cdiv(every, min(every, pl.cdiv(PROGRAMS, count)))
    parts = pl.cdiv(every, steps)
    wide = jnp.promote_types(arrays[0].dtype, jnp.float32)
    check_numbers("pixel_sums", *(array.shape for array in arrays))
    images = len(arrays) - (0 if gate is None else 2)
    used = _used(pairs, gate)

    def program(*references: Any) -> None:
        (*read, sums), image, part = references, pl.program_id(0), pl.program_id(1)
        row, column = jnp.arange(rows, dtype=jnp.int32)[:, None], jnp.arange(columns, dtype=jnp.int32)[None]
        if gate is not None:
            scale = triton.load(read[images].at[image])
            shift = triton.load(read[images + 1].at[image, column], mask=column < channels, other=0)

        def add(step: jax.Array, totals: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            at = (part * steps + step) * rows + row
            inside, where = (at < pixels) & (column < channels), at * channels + column
            seen = {i: triton.load(read[i].at[image, where], mask=inside, other=0).astype(wide) for i in used}
            one, product = seen[pairs[0][0]], sum(seen[u] * seen[v] for u, v in pairs)
            if gate is not None:
                one, product = (jnp.where(seen[gate] * scale + shift > 0, each, 0) for each in (one, product))
            return totals[0] + one, totals[1] + product

        zeros = jnp.zeros((rows, columns), wide)
        for number, total in enumerate(lax.fori_loop(0, steps, add, (zeros, zeros))):
            triton.store(sums.at[image, part, number, column[0]], total.sum(axis=0), mask=column[0] < channels)

    call = pl.pallas_call(
        program,
        out_shape=jax.ShapeDtypeStruct((count, parts, 2, channels), wide),
        grid=(count, parts),
        compiler_params=triton.CompilerParams(num_warps=4, num_stages=1),
        interpret=interpret,
        name="pixel_sums",
    )
    flat = (array.reshape(count, -1) if number < images else array for number, array in enumerate(arrays))
    return call(*flat).sum(axis=1)


def _used(pairs: Pairs, gate: int | None) -> list[int]:
    """Lists the numbers of the images that are read."""
    return sorted({number for pair in pairs for number in pair} | (set() if gate is None else {gate}))


def _keep(arrays: Sequence[Any], gate: int | None) -> Any:
    """Computes k: [N, P, F], or 1."""
    return 1 if gate is None else scale_and_shift(arrays[gate], *arrays[-2:]) > 0


def _sum_plainly(*arrays: jax.Array, pairs: Pairs, gate: int | None) -> jax.Array:
    """Computes what `_sum_pixels` does on any device."""
    images = [array.astype(jnp.promote_types(array.dtype, jnp.float32)) for array in arrays]
    sums = images[pairs[0][0]], sum(images[u] * images[v] for u, v in pairs)
    return jnp.stack([(_keep(images, gate) * each).sum(axis=1) for each in sums], axis=1)


_sums = operation(_sum_pixels, _sum_plainly)


def _jvp(
    primals: Sequence[Any], tangents: Sequence[Any], *, pairs: Pairs, gate: int | None, interpret: bool
) -> tuple[jax.Array, jax.Array]:
    """Differentiates the products; k is constant but for a few pixels."""
    gated = 0 if gate is None else 2
    images = list(primals[: len(primals) - gated])
    changes: dict[int, int] = {}
    for number, tangent in enumerate(tangents[: len(images)]):
        if number == pairs[0][0] or not isinstance(tangent, ad.Zero):  # the first sum is that of a tangent
            changes[number] = len(images)
            images.append(ad.instantiate_zeros(tangent))
    more: list[tuple[int, int]] = []
    for u, v in pairs:
        more += [(changes[u], v)] if u in changes else []
        more += [(u, changes[v])] if v in changes else []
    used = _used(tuple(more), gate)
    place = {number: index for index, number in enumerate(used)}
    value = _sums.bind(*primals, pairs=pairs, gate=gate, interpret=interpret)
    change = _sums.bind(
        *(images[number] for number in used),
        *primals[len(primals) - gated :],
        pairs=tuple((place[u], place[v]) for u, v in more),
        gate=None if gate is None else place[gate],
        interpret=interpret,
    )
    return value, change


def _transpose(gradient: Any, *arrays: Any, pairs: Pairs, gate: int | None, **_: Any) -> list[Any]:
    """Computes the gradients by those images that are not known, one of a pair at most."""
    if isinstance(gradient, ad.Zero):
        return [ad.Zero(array.aval) if ad.is_undefined_primal(array) else None for array in arrays]
    by_one, by_product = gradient[:, :1], gradient[:, 1:]
    keep = _keep(arrays, gate)

    def by(number: int, like: Any) -> jax.Array:
        total = jnp.broadcast_to(by_one, like.shape) if number == pairs[0][0] else jnp.zeros(like.shape, gradient.dtype)
        for u, v in pairs:
            total = total + arrays[v] * by_product if u == number else total
            total = total + arrays[u] * by_product if v == number else total
        return (keep * total).astype(like.dtype)

    return [by(i, array.aval) if ad.is_undefined_primal(array) else None for i, array in enumerate(arrays)]


def _map(args: Sequence[jax.Array], axes: Sequence[int | None], **settings: Any) -> tuple[jax.Array, int]:
    """Maps over tasks, whose images join the others; if there are too many numbers, one task after the other."""
    count = next(arg.shape[axis] for arg, axis in zip(args, axes, strict=True) if axis is not None)
    each = [
        jnp.broadcast_to(arg, (count, *arg.shape)) if axis is None else jnp.moveaxis(arg, axis, 0)
        for arg, axis in zip(args, axes, strict=True)
    ]
    if each[0].size > MOST_NUMBERS:
        return lax.map(lambda args: _sums.bind(*args, **settings), each), 0
    found = _sums.bind(*(arg.reshape(-1, *arg.shape[2:]) for arg in each), **settings)
    return found.reshape(count, -1, *found.shape[1:]), 0


ad.primitive_jvps[_sums] = _jvp
ad.primitive_transposes[_sums] = _transpose
batching.primitive_batchers[_sums] = _map
