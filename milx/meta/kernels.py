"""Convolutions of tasks, each with a kernel of its own, as kernels of a GPU: the value and both of its transposes.

With stride s, and a rows and a' columns of zeros before the image, all three are sums over

    y[t, b, p, q, f] = sum over i, j, c of x[t, b, s p + i - a, s q + j - a', c] W[t, i, j, c, f],

which is linear in x and in W. The value, and its transpose in x, are products of windows and weights; the transpose in
W is a product of windows and tiles (`tiles.py`). A program keeps its place in the image and goes from image to image,
so that what lies outside, and the weights, are the same for all of them. Windows are read from the caches of the GPU as
often as they overlap, and are not copied.

All raise a ValueError for more than `MOST_NUMBERS` numbers in an array, those of all tasks together. They are meant
for up to 64 channels and filters (`MOST_CHANNELS`). Products are summed in float32, or in float64 where the numbers
are. Numbers of 32 bits are multiplied as TF32.
"""

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

from milx.meta.operations import PROGRAMS, check_numbers
from milx.meta.tiles import Geometry, Pair, Places, Tiles, of_inputs, of_outputs, places

# The numbers below, but for that of shared memory, were chosen by timing push's and reach's layers on an H200, in
# bfloat16.
_LEAST = 16
"""Least side of the matrices that are multiplied."""
_BYTES = 256
"""Bytes of a row of the matrix of windows that is multiplied, at most, and of a column of it."""
_TOTALS = 8192
"""Most sums of a program that computes values of the convolution."""
_KEPT = 96 * 1024
"""Most bytes of weights that a program keeps; it reads more of them anew for every image."""
_SUMS = 8192
"""Most sums for all rows of a window that one program keeps; for more there is a program for each row."""
_MORE = 20480
"""The same for images of four channels."""
_SHARED = 200 * 1024
"""Most bytes that a program reads ahead, three steps at once; an H200 has 227 KiB of shared memory."""
_SUMMING = PROGRAMS // 4
"""Programs to start at least where each writes sums of its own, which XLA adds."""


def convolve(*pairs: jax.Array, geometry: Geometry, interpret: bool = False) -> jax.Array:
    """Computes y, [T, B, P, Q, F], of x, [T, B, H, W, C], and W, [T, k, k, C, F], or [1, k, k, C, F] for all tasks.

    With more pairs x and W, their results are added before they are rounded; so are those of the other two functions.

    Args:
        pairs: x and W, and further pairs of the same shapes, but that each W may have one task or all.
        geometry: the sizes.
        interpret: run on any device, slowly, for tests.
    """
    channels, filters = pairs[1].shape[3:]
    wide = 2 if filters <= 32 else 1
    one, two = (of_outputs(geometry, channels, filters, (rows, wide), pairs[0].dtype.itemsize) for rows in (1, 2))
    tiles = two if channels > 4 and _keeps(two, geometry.taps, pairs) else one
    count = min(_at_once(pairs), _TOTALS // (tiles.tile[0] * _columns(tiles)))
    return _multiply(pairs, geometry.taps, tiles, (filters, 1), count, "convolve", interpret)


def to_input(*pairs: jax.Array, geometry: Geometry, interpret: bool = False) -> jax.Array:
    """Computes the transpose in x, [T, B, H, W, C], of dy, [T, B, P, Q, F], by W, which is as in `convolve`."""
    channels, filters = pairs[1].shape[3:]
    tiles = of_inputs(geometry, channels, filters)
    return _multiply(pairs, geometry.taps, tiles, (1, filters), _at_once(pairs), "to_input", interpret)


def to_kernel(*pairs: jax.Array, geometry: Geometry, interpret: bool = False) -> jax.Array:
    """Computes the transpose in W, [T, k, k, C, F], of dy, [T, B, P, Q, F], by x, [T, B, H, W, C]: pairs are x and dy.

    Programs sum over some of the pixels each, and their sums are added.
    """
    stride, taps = geometry.stride, geometry.taps
    channels, filters = pairs[0].shape[-1], pairs[1].shape[-1]
    wide = 1 if filters > 16 else 4 if channels <= 4 else 2
    tiles = of_outputs(geometry, channels, filters, (1, wide), pairs[0].dtype.itemsize)
    sums = _sum_products(pairs, tiles, interpret)
    pixels = (sums[:, :, stride * j : stride * j + taps, :, j] for j in range(tiles.tile[1]))
    return functools.reduce(jnp.add, pixels).astype(pairs[0].dtype)


def _multiply(
    pairs: Sequence[jax.Array], taps: int, tiles: Tiles, strides: Pair, count: int, name: str, interpret: bool
) -> jax.Array:
    """Multiplies windows by weights: [T, B, rows, columns, channels] that are written.

    Args:
        pairs: images that are read, [T, B, ...], and kernels, [T, k, k, C, F] or [1, k, k, C, F].
        taps: k.
        tiles: what is computed.
        strides: from a channel that is read, and from one that is written, to the next in the kernel's memory.
        count: windows that a program multiplies at once.
        name: of the operation.
        interpret: run on any device, slowly, for tests.
    """
    (tasks, images), dtype = pairs[0].shape[:2], pairs[0].dtype
    columns, pieces, meetings = _columns(tiles), list(_pieces(tiles, dtype)), _meetings(tiles, taps)
    keeps, sums = _keeps(tiles, taps, pairs), tiles.tile[0] * columns
    at = places(tiles, images, count, tasks, PROGRAMS)
    shared = [len(kernel) < tasks for kernel in pairs[1::2]]
    parts = list(itertools.product(range(len(shared)), sorted({row for row, _ in meetings}), pieces))

    def program(*references):
        (*read, y), (place, chunk, task) = references, (pl.program_id(axis) for axis in range(3))
        spot = _spot(at, place)

        def load(pair: int, row: int, pixel: int, piece: Pair) -> jax.Array:
            where, inside = _of_weights(tiles, taps, row, pixel, piece, strides)
            return _load(read[2 * pair + 1].at[0 if shared[pair] else task, where], inside)

        every = [(pair, *meeting, piece) for pair, row, piece in parts for meeting in meetings if meeting[0] == row]
        weights = {each: load(*each) for each in every if keeps}

        def step(number, carried):
            number += chunk * at.steps
            totals = [jnp.zeros((len(spot.row), columns), _wide(dtype)) for _ in range(tiles.tile[0])]
            for pair, row, piece in parts:
                where, inside = _at_step(_of_windows(tiles, spot, row, piece), tiles.read, at, spot, number, images)
                windows = _load(read[2 * pair].at[task, where], inside)
                for pixel in (pixel for other, pixel in meetings if other == row):
                    each = pair, row, pixel, piece
                    totals[pixel] += _product(windows, weights[each] if keeps else load(*each), 1)
            for pixel, total in enumerate(totals):
                where, inside = _at_step(_of_tiles(tiles, spot, pixel), tiles.written, at, spot, number, images)
                _store(y.at[task, where], total, inside)
            return carried

        lax.fori_loop(0, at.steps, step, 0)

    grid = math.prod(at.grid), at.chunks, tasks
    shape = tasks, images * math.prod(tiles.written)
    call = _call(program, shape, dtype, grid, name, 4 if sums <= 128 else 8, 1, interpret)
    return call(*(array.reshape(len(array), -1) for array in pairs)).reshape(tasks, images, *tiles.written)


def _sum_products(pairs: Sequence[jax.Array], tiles: Tiles, interpret: bool) -> jax.Array:
    """Sums the products of windows and tiles of one row, u' outputs: [T, rows and columns of a window, C, u', F]."""
    (tasks, images), dtype = pairs[0].shape[:2], pairs[0].dtype
    columns, pieces = _columns(tiles), list(_pieces(tiles, dtype, 4 * _LEAST))
    (rows, length), channels = tiles.window, tiles.read[2]
    sums = rows * columns * sum(width for _, width in pieces)
    many = sums > _SUMS
    alone = not many or (channels <= 4 and sums <= _MORE)  # a program keeps the sums for all rows of a window
    others = tasks if alone else tasks * rows
    count = 64 if many or sums <= _SUMS // 2 else 32
    count = max(_LEAST, count * 2 // dtype.itemsize)
    at = places(tiles, images, count, others, _SUMMING)
    there = math.prod(at.grid)
    each = max(1, there * at.chunks * others // PROGRAMS)  # places of a program, so that few sums are left to add
    programs = pl.cdiv(there, each)

    def program(*references):
        (*read, found), (group, chunk, task) = references, (pl.program_id(axis) for axis in range(3))
        mine = list(range(rows)) if alone else [group % rows]
        group, n = group if alone else group // rows, _numbers(columns)

        def step(number, totals, spot):
            number += chunk * at.steps
            for x, dy in zip(read[::2], read[1::2], strict=True):
                where, inside = _at_step(_of_tiles(tiles, spot, 0), tiles.written, at, spot, number, images)
                given, more = _load(dy.at[task, where], inside), []
                for total, (row, piece) in zip(totals, itertools.product(mine, pieces), strict=True):
                    where, inside = _at_step(_of_windows(tiles, spot, row, piece), tiles.read, at, spot, number, images)
                    more.append(total + _product(_load(x.at[task, where], inside), given, 0))
                totals = tuple(more)
            return totals

        def at_place(number, totals):
            step_there = functools.partial(step, spot=_spot(at, group * each + number))
            return lax.fori_loop(0, at.steps, step_there, totals)

        start = tuple(jnp.zeros((width, columns), _wide(dtype)) for _ in mine for _, width in pieces)
        totals = lax.fori_loop(0, each, at_place, start)
        for (row, (first, width)), total in zip(itertools.product(mine, pieces), totals, strict=True):
            r = _numbers(width)[:, None] + first
            inside = (r < length * channels) & (n < tiles.tile[1] * tiles.written[2])[None]
            _store(found.at[group * at.chunks + chunk, task, row, r, n[None]], total, inside)

    shape = programs * at.chunks, tasks, rows, length * channels, tiles.tile[1] * tiles.written[2]
    grid = programs * (1 if alone else rows), at.chunks, tasks
    wide = sum(width for _, width in pieces) * (rows if alone else 1)
    read = len(pairs) // 2 * count * (columns + wide) * dtype.itemsize
    stages = 3 if many and 3 * read <= _SHARED else 1
    call = _call(program, shape, _wide(dtype), grid, "to_kernel", 4 if many else 2, stages, interpret)
    total = call(*(array.reshape(tasks, -1) for array in pairs)).sum(axis=0)
    return total.reshape(tasks, rows, length, channels, tiles.tile[1], tiles.written[2])


class _Spot(NamedTuple):
    """The M tiles that a program has at once: [M] images, counted from its first, rows and columns."""

    image: jax.Array
    row: jax.Array
    column: jax.Array


def _spot(at: Places, place: jax.Array) -> _Spot:
    """Finds the tiles of the place of this number, counted row by row."""
    number = _numbers(at.images * at.rows * at.columns)
    rest = number // at.columns
    first = place // at.grid[1] * at.rows, place % at.grid[1] * at.columns
    return _Spot(rest // at.rows, first[0] + rest % at.rows, first[1] + number % at.columns)


def _of_windows(tiles: Tiles, spot: _Spot, row: Any, piece: Pair) -> tuple[jax.Array, jax.Array]:
    """Finds a piece, by first and width, of a row of each window, whose numbers are next to each other.

    Returns:
        Where they are, as if the program began with the first image, and whether they are in the image: [M, width].
    """
    height, width, channels = tiles.read
    r = _numbers(piece[1]) + piece[0]
    top = spot.row * tiles.step[0] - tiles.before[0] + row
    along = ((spot.column * tiles.step[1] - tiles.before[1]) * channels)[:, None] + r[None]
    inside = (along >= 0) & (along < width * channels) & ((top >= 0) & (top < height))[:, None]
    if sum(piece) > tiles.window[1] * channels:
        inside &= (r < tiles.window[1] * channels)[None]
    return ((spot.image * height + top) * (width * channels))[:, None] + along, inside


def _of_tiles(tiles: Tiles, spot: _Spot, pixel: int) -> tuple[jax.Array, jax.Array]:
    """Finds a row of each tile, as `_of_windows` does: [M, columns]."""
    height, width, channels = tiles.written
    n = _numbers(_columns(tiles))
    top = spot.row * tiles.tile[0] + pixel
    along = (spot.column * (tiles.tile[1] * channels))[:, None] + n[None]
    inside = (along < width * channels) & (top < height)[:, None]
    if len(n) > tiles.tile[1] * channels:
        inside &= (n < tiles.tile[1] * channels)[None]
    return ((spot.image * height + top) * (width * channels))[:, None] + along, inside


def _at_step(where: tuple, size: tuple[int, int, int], at: Places, spot: _Spot, step: Any, images: int) -> tuple:
    """Moves on to the images, of a size, of a step; the last steps may have fewer of them, or none."""
    numbers, inside = where
    if at.images * at.steps * at.chunks > images:
        inside &= (step * at.images + spot.image < images)[:, None]
    return step * (at.images * math.prod(size)) + numbers, inside


def _meetings(tiles: Tiles, taps: int) -> list[Pair]:
    """Lists the rows of windows and of tiles that meet at a tap of the kernel, by the first."""
    rows = itertools.product(range(tiles.window[0]), range(tiles.tile[0]))
    return [(row, pixel) for row, pixel in rows if 0 <= tiles.lines[0].at(row, pixel) < taps]


def _of_weights(
    tiles: Tiles, taps: int, row: int, pixel: int, piece: Pair, strides: Pair
) -> tuple[jax.Array, jax.Array]:
    """Finds the weights of a piece of a row of windows, and of a row of tiles: [width, columns], as `_of_windows`."""
    (_, _, read), (_, _, written) = tiles.read, tiles.written
    r, n = _numbers(piece[1])[:, None] + piece[0], _numbers(_columns(tiles))[None]
    tap = tiles.lines[1].at(r // read, n // written)
    inside = (tap >= 0) & (tap < taps) & (r < tiles.window[1] * read) & (n < tiles.tile[1] * written)
    where = (tiles.lines[0].at(row, pixel) * taps + tap) * (read * written)
    return where + r % read * strides[0] + n % written * strides[1], inside


def _keeps(tiles: Tiles, taps: int, pairs: Sequence[jax.Array]) -> bool:
    """Tells whether a program keeps the weights of all pairs."""
    width = sum(width for _, width in _pieces(tiles, pairs[0].dtype))
    numbers = len(_meetings(tiles, taps)) * width * _columns(tiles) * len(pairs[::2])
    return numbers * pairs[0].dtype.itemsize <= _KEPT


def _pieces(tiles: Tiles, dtype: Any, least: int = 2 * _LEAST) -> Iterator[Pair]:
    """Cuts the numbers of a row of a window into pieces: first and width of each.

    Widths are powers of two, so the last piece may reach beyond the end: by a quarter, or up to the `least` width.
    """
    first, length = 0, tiles.window[1] * tiles.read[2]
    while first < length:
        rest = length - first
        width = min(_power_of_two(rest), _BYTES // jnp.dtype(dtype).itemsize)
        if width > max(1.25 * rest, least):
            width //= 2
        yield first, width
        first += width


def _at_once(pairs: Sequence[jax.Array]) -> int:
    """Counts the windows that a program multiplies at once, at most."""
    return _BYTES // pairs[0].dtype.itemsize


def _columns(tiles: Tiles) -> int:
    """Rounds the numbers of a row of a tile up to a width that is multiplied."""
    return _power_of_two(tiles.tile[1] * tiles.written[2])


def _power_of_two(length: int) -> int:
    return max(_LEAST, pl.next_power_of_2(length))


def _numbers(count: int) -> jax.Array:
    return jnp.arange(count, dtype=jnp.int32)


def _wide(dtype: Any) -> Any:
    return jnp.promote_types(dtype, jnp.float32)


def _product(a: jax.Array, b: jax.Array, contract: int) -> jax.Array:
    """Multiplies [M, K], or [K, M] if its axis 0 is contracted, by [K, N]."""
    axes = (((contract,), (0,)), ((), ()))
    return lax.dot_general(a, b, axes, preferred_element_type=_wide(a.dtype))


def _load(reference: Any, mask: jax.Array) -> jax.Array:
    return triton.load(reference, mask=mask, other=0)


def _store(reference: Any, value: jax.Array, mask: jax.Array) -> None:
    triton.store(reference, value.astype(reference.dtype), mask=mask)


def _call(
    program: Any,
    shape: tuple[int, ...],
    dtype: Any,
    grid: tuple[int, ...],
    name: str,
    warps: int,
    stages: int,
    interpret: bool,
) -> Callable[..., jax.Array]:
    """Returns a function of arrays that runs the program on a grid."""
    call = pl.pallas_call(
        program,
        out_shape=jax.ShapeDtypeStruct(shape, dtype),
        grid=grid,
        compiler_params=triton.CompilerParams(num_warps=warps, num_stages=stages),
        interpret=interpret,
        name=name,
    )

    def run(*arrays: jax.Array) -> jax.Array:
        check_numbers(name, shape, *(array.shape for array in arrays))
        return call(*arrays)

    return run
