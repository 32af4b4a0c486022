"""Convolutions of tasks, each with a kernel of its own, as kernels of a GPU: the value and both of its transposes.

With stride s, and a rows and a' columns of zeros before the image (TensorFlow's SAME), all three are sums over

    y[t, b, p, q, f] = sum over i, j, c of x[t, b, s p + i - a, s q + j - a', c] W[t, i, j, c, f],

which is linear in x and in W. Each program multiplies matrices: what lies under row i of the window of many outputs,
where j and c are next to each other in memory, by row i of the kernel. So images are read from the caches of the GPU
as often as windows overlap, and windows are not copied.

All raise a ValueError for more than `MOST_COLUMNS` filters or `MOST_NUMBERS` numbers in an array, those of all tasks
together. Products are summed in float32, or in float64 where the numbers are. Numbers of 32 bits are multiplied as the
GPU does by default, which is TF32.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

from milx.meta.convolution import same_padding

_PIXELS = 128
"""Outputs of a program."""
_PIXELS_AT_ONCE = 64
"""Outputs in a step of a program that sums over them."""
_PROGRAMS = 528
"""Programs that `to_kernel` starts if there are enough outputs: four for each multiprocessor of an H100 or H200."""
_LEAST = 16
"""Least side of the matrices that are multiplied."""
_BYTES = 256
"""Most bytes in a row of the left matrix."""
_WARPS = 4
MOST_COLUMNS = 128
"""Most filters, and most channels of images that need a gradient: a program sums as many numbers for each output."""
MOST_NUMBERS = 2**31 - 2**16
"""Most numbers in an array, so that 32 bits count them, and the outputs that the last programs have beyond its end."""


def convolve(x: jax.Array, kernel: jax.Array, *, stride: int, interpret: bool = False) -> jax.Array:
    """Computes y, [T, B, P, Q, F], of x, [T, B, H, W, C], and W, [T, k, k, C, F], or [1, k, k, C, F] for all tasks."""
    tasks, images, *size, channels = x.shape
    shared, taps, _, _, filters = kernel.shape
    shape = tuple(-(-length // stride) for length in size)
    before = [same_padding(length, taps, stride)[0] for length in size]
    count = images * shape[0] * shape[1]

    def program(x, kernel, y):
        task, pixel = pl.program_id(1), _numbers(_PIXELS) + pl.program_id(0) * _PIXELS
        image, top, left = _place(pixel, shape)
        first, valid = (image, top * stride - before[0], left * stride - before[1]), pixel < count
        windows = _Windows(x, task, size, channels, taps, first, valid)
        f = _numbers(_columns(filters))
        weights = lambda *indices: kernel.at[task if shared > 1 else 0, *indices]  # noqa: E731
        total = _sum(windows, weights, filters)
        _store(y.at[task, pixel[:, None], f[None]], total, valid[:, None] & (f < filters)[None])

    y = _call(program, (tasks, count, filters), x.dtype, (pl.cdiv(count, _PIXELS), tasks), "convolve", interpret)(
        x.reshape(tasks, -1), kernel.reshape(shared, taps, taps * channels, filters)
    )
    return y.reshape(tasks, images, *shape, filters)


def to_input(
    dy: jax.Array, kernel: jax.Array, *, stride: int, size: tuple[int, int], interpret: bool = False
) -> jax.Array:
    """Computes the transpose in x, [T, B, H, W, C], of dy, [T, B, P, Q, F], by W, [T, k, k, C, F] or [1, k, k, C, F].

    Pixels whose row and column leave the same remainders by s meet the same rows and columns of the kernel, every s-th
    of them, in reverse. So each of the s² kinds of pixels is what a convolution with a smaller kernel gives.
    """
    tasks, images, *shape, filters = dy.shape
    shared, taps, _, channels, _ = kernel.shape
    fewer = pl.cdiv(taps, stride)
    before = [same_padding(length, taps, stride)[0] for length in size]
    kernel = jnp.pad(kernel, ((0, 0), *[(0, fewer * stride - taps)] * 2, (0, 0), (0, 0)))
    kernel = kernel.reshape(shared, fewer, stride, fewer, stride, channels, filters)[:, ::-1, :, ::-1]
    kernel = kernel.transpose(0, 2, 4, 1, 3, 6, 5).reshape(shared, stride, stride, fewer, fewer * filters, channels)
    coarse = tuple(-(-length // stride) for length in size)
    count = images * coarse[0] * coarse[1]

    def program(dy, kernel, dx):
        task, pixel = pl.program_id(1), _numbers(_PIXELS) + pl.program_id(0) * _PIXELS
        image, top, left = _place(pixel, coarse)
        c = _numbers(_columns(channels))
        for kind in ((row, column) for row in range(stride) for column in range(stride)):
            y, x = top * stride + kind[0], left * stride + kind[1]
            valid = (pixel < count) & (y < size[0]) & (x < size[1])
            (down, i), (right, j) = (divmod(offset + pad, stride) for offset, pad in zip(kind, before, strict=True))
            first = image, top + down - (fewer - 1), left + right - (fewer - 1)
            windows = _Windows(dy, task, shape, filters, fewer, first, valid)
            weights = lambda *indices, i=i, j=j: kernel.at[task if shared > 1 else 0, i, j, *indices]  # noqa: E731
            total = _sum(windows, weights, channels, start=fewer - pl.cdiv(taps - i, stride))
            at = ((image * size[0] + y) * size[1] + x) * channels
            _store(dx.at[task, at[:, None] + c[None]], total, valid[:, None] & (c < channels)[None])

    numbers = images * size[0] * size[1] * channels
    dx = _call(program, (tasks, numbers), dy.dtype, (pl.cdiv(count, _PIXELS), tasks), "to_input", interpret)(
        dy.reshape(tasks, -1), kernel
    )
    return dx.reshape(tasks, images, *size, channels)


def to_kernel(x: jax.Array, dy: jax.Array, *, stride: int, taps: int, interpret: bool = False) -> jax.Array:
    """Computes the transpose in W, [T, k, k, C, F], of dy, [T, B, P, Q, F], by x, [T, B, H, W, C]; k are the taps.

    Several programs sum over some of the outputs each, for a row of the kernel, and their sums are added.
    """
    tasks, images, *size, channels = x.shape
    *shape, filters = dy.shape[2:]
    before = [same_padding(length, taps, stride)[0] for length in size]
    pieces = list(_pieces(taps * channels, x.dtype))
    count = images * shape[0] * shape[1]
    columns = _columns(filters)
    steps = pl.cdiv(count, _PIXELS_AT_ONCE)
    groups = min(steps, pl.cdiv(_PROGRAMS, tasks * taps))
    steps = pl.cdiv(steps, groups)

    def program(x, dy, dkernel):
        row, group, task = (pl.program_id(axis) for axis in range(3))
        f = _numbers(columns)

        def add(step, totals):
            pixel = _numbers(_PIXELS_AT_ONCE) + (group * steps + step) * _PIXELS_AT_ONCE
            image, top, left = _place(pixel, shape)
            first, valid = (image, top * stride - before[0], left * stride - before[1]), pixel < count
            windows = _Windows(x, task, size, channels, taps, first, valid)
            given = _load(dy.at[task, pixel[:, None], f[None]], valid[:, None] & (f < filters)[None])
            under = [_under(windows, row, piece) for piece in pieces]
            return tuple(total + _product(left, given, 0) for total, left in zip(totals, under, strict=True))

        start = tuple(jnp.zeros((width, columns), _wide(x.dtype)) for _, width in pieces)
        for (first, width), total in zip(pieces, lax.fori_loop(0, steps, add, start), strict=True):
            r = _numbers(width) + first
            mask = (r < taps * channels)[:, None] & (f < filters)[None]
            _store(dkernel.at[group, task, row, r[:, None], f[None]], total, mask)

    sums = groups, tasks, taps, taps * channels, filters
    parts = _call(program, sums, _wide(x.dtype), (taps, groups, tasks), "to_kernel", interpret)(
        x.reshape(tasks, -1), dy.reshape(tasks, count, filters)
    )
    return parts.sum(axis=0).astype(x.dtype).reshape(tasks, taps, taps, channels, filters)


class _Windows(NamedTuple):
    """What lies under M windows of k rows and columns.

    Attributes:
        images: a reference to [T, B H W C] numbers.
        task: which of the T.
        size: H and W.
        channels: C.
        taps: k.
        first: [M] images, and the rows and columns of the windows' first pixels, which may be outside the image.
        valid: [M] bool, whether there is such a window.
    """

    images: Any
    task: jax.Array
    size: list[int]
    channels: int
    taps: int
    first: tuple[jax.Array, jax.Array, jax.Array]
    valid: jax.Array


def _sum(windows: _Windows, weights: Callable[..., Any], filters: int, start: int = 0) -> jax.Array:
    """Sums what lies under windows, times a kernel: [M, F], with F rounded up by `_columns`.

    Args:
        windows: M windows.
        weights: returns a reference to numbers of the kernel from their row, their places in it, and their filters.
        filters: F.
        start: the kernel's rows before this one are zero.
    """
    f, length = _numbers(_columns(filters)), windows.taps * windows.channels

    def add(row: jax.Array, total: jax.Array) -> jax.Array:
        for piece in _pieces(length, windows.images.dtype):
            r = _numbers(piece[1]) + piece[0]
            mask = (r < length)[:, None] & (f < filters)[None]
            total += _product(_under(windows, row, piece), _load(weights(row, r[:, None], f[None]), mask))
        return total

    none = jnp.zeros((len(windows.valid), len(f)), _wide(windows.images.dtype))
    return lax.fori_loop(start, windows.taps, add, none)


def _under(windows: _Windows, row: Any, piece: tuple[int, int]) -> jax.Array:
    """Loads a piece, by first and width, of the k C numbers under a row of windows: [M, width].

    It has zeros outside of the image and of the window.
    """
    (height, width), channels = windows.size, windows.channels
    number, top, left = windows.first
    r = _numbers(piece[1]) + piece[0]
    column = left[:, None] + lax.div(r, jnp.int32(channels))[None]
    inside = (column >= 0) & (column < width) & (r < windows.taps * channels)[None]
    inside &= (windows.valid & (top + row >= 0) & (top + row < height))[:, None]
    at = ((number * height + top + row) * width + left) * channels
    return _load(windows.images.at[windows.task, at[:, None] + r[None]], inside)


def _pieces(length: int, dtype: Any) -> Iterator[tuple[int, int]]:
    """Cuts `length` numbers of a type into pieces: first and width of each.

    Widths are powers of two, so the last piece may reach beyond the end.
    """
    first = 0
    while first < length:
        rest = length - first
        width = min(_power_of_two(rest), _BYTES // jnp.dtype(dtype).itemsize)
        if width > max(1.25 * rest, 2 * _LEAST):
            width //= 2
        yield first, width
        first += width


def _place(pixel: jax.Array, shape: tuple[int, ...] | list[int]) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Finds image, row and column of each of B P Q pixels; the quotients of positive numbers need no rounding."""
    line = lax.div(pixel, jnp.int32(shape[1]))
    image = lax.div(line, jnp.int32(shape[0]))
    return image, line - image * shape[0], pixel - line * shape[1]


def _columns(numbers: int) -> int:
    """Rounds the number of filters or channels up to a width that is multiplied; raises ValueError for too many."""
    if numbers > MOST_COLUMNS:
        raise ValueError(f"filters or channels: got {numbers}, expected at most {MOST_COLUMNS}")
    return _power_of_two(numbers)


def _power_of_two(length: int) -> int:
    return max(_LEAST, pl.next_power_of_2(length))


def _numbers(count: int) -> jax.Array:
    return jnp.arange(count, dtype=jnp.int32)


def _wide(dtype: Any) -> Any:
    return jnp.promote_types(dtype, jnp.float32)


def _product(a: jax.Array, b: jax.Array, contract: int = 1) -> jax.Array:
    """Multiplies [M, K], or [K, M] if its axis 0 is contracted, by [K, N]."""
    axes = (((contract,), (0,)), ((), ()))
    return lax.dot_general(a, b, axes, preferred_element_type=_wide(a.dtype))


def _load(reference: Any, mask: jax.Array) -> jax.Array:
    return triton.load(reference, mask=mask, other=0)


def _store(reference: Any, value: jax.Array, mask: jax.Array) -> None:
    triton.store(reference, value.astype(reference.dtype), mask=mask)


def _call(
    program: Any, shape: tuple[int, ...], dtype: Any, grid: tuple[int, ...], name: str, interpret: bool
) -> Callable[..., jax.Array]:
    """Returns a function of arrays that runs the program on a grid."""
    call = pl.pallas_call(
        program,
        out_shape=jax.ShapeDtypeStruct(shape, dtype),
        grid=grid,
        compiler_params=triton.CompilerParams(num_warps=_WARPS, num_stages=3),
        interpret=interpret,
        name=name,
    )

    def run(*arrays: jax.Array) -> jax.Array:
        for numbers in (math.prod(shape), *(array.size for array in arrays)):
            if numbers > MOST_NUMBERS:
                raise ValueError(f"{name}: got an array of {numbers} numbers, expected at most {MOST_NUMBERS}")
        return call(*arrays)

    return run
