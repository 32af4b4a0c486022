"""Which numbers of an image depend on which others in a convolution, and how programs of a GPU share them.

Pixels that are written next to each other make a tile, and a tile depends on a window of the image that is read:
u x u' outputs of a convolution on its (s (u - 1) + k) x (s (u' - 1) + k) inputs, and the s x s pixels of a gradient by
the image on the gradients of the outputs that saw them. All windows have the same size and are the same step apart, so
that windows are the rows of a matrix, which is multiplied by weights that repeat the kernel for each pixel of a tile.
"""

import math
from typing import Any, NamedTuple

Pair = tuple[int, int]
"""Rows and columns."""


class Geometry(NamedTuple):
    """A convolution's sizes.

    Attributes:
        stride: s.
        taps: k, of the kernel.
        before: rows and columns of zeros before the image.
        size: of the image.
        shape: of the result.
    """

    stride: int
    taps: int
    before: Pair
    size: Pair
    shape: Pair


class Line(NamedTuple):
    """Along one axis: pixel d of a window meets pixel r of its tile at the kernel's tap of window d + tile r + first.

    Attributes:
        window: taps from one pixel of a window to the next.
        tile: taps from one pixel of a tile to the next.
        first: the tap for the first pixels of both.
    """

    window: int
    tile: int
    first: int

    def at(self, window: Any, tile: Any) -> Any:
        """Finds the tap, which may be none of the kernel's."""
        return self.window * window + self.tile * tile + self.first


class Tiles(NamedTuple):
    """How images that are written depend on images that are read.

    Attributes:
        tile: pixels of a tile.
        window: pixels of a window.
        step: pixels from a window to the next.
        before: pixels by which the first window begins before the image.
        read: rows, columns and channels of the images that are read.
        written: those of the images that are written.
        lines: where they meet along rows, and along columns.
    """

    tile: Pair
    window: Pair
    step: Pair
    before: Pair
    read: tuple[int, int, int]
    written: tuple[int, int, int]
    lines: tuple[Line, Line]


def of_outputs(geometry: Geometry, channels: int, filters: int, tile: Pair, itemsize: int) -> Tiles:
    """Makes tiles of a convolution's outputs.

    Args:
        geometry: of the convolution.
        channels: of the image.
        filters: of the result.
        tile: outputs of a tile.
        itemsize: bytes of a number. Windows of four channels are widened so that their rows are read 16 bytes at once.
    """
    stride, taps, before, size, shape = geometry
    rows, columns = (stride * (count - 1) + taps for count in tile)
    if channels == 4:
        columns += -columns % max(1, 4 // itemsize)
    step = stride * tile[0], stride * tile[1]
    tap = Line(1, -stride, 0)
    return Tiles(tile, (rows, columns), step, before, (*size, channels), (*shape, filters), (tap, tap))


def of_inputs(geometry: Geometry, channels: int, filters: int) -> Tiles:
    """Makes tiles of the gradient by the image, of s x s pixels.

    Pixel s p + r has the sum over e of the gradient by output p + e times the kernel's tap r + a - s e, where there is
    one: e goes from the least for r = 0 to the greatest for r = s - 1.
    """
    stride, taps, before, size, shape = geometry
    least = [-((taps - 1 - zeros) // stride) for zeros in before]
    rows, columns = ((stride - 1 + zeros) // stride - e + 1 for zeros, e in zip(before, least, strict=True))
    down, across = (Line(-stride, 1, zeros - stride * e) for zeros, e in zip(before, least, strict=True))
    begins = -least[0], -least[1]
    tile = stride, stride
    return Tiles(tile, (rows, columns), (1, 1), begins, (*shape, filters), (*size, channels), (down, across))


class Places(NamedTuple):
    """Which tiles of which images a program has at once, and how programs share places and images.

    Attributes:
        images: how many it has at once.
        rows: of tiles that it has at once.
        columns: of tiles that it has at once.
        grid: how many places there are, in rows and columns.
        steps: how often a program, which keeps its place, goes on to the next images.
        chunks: how many programs share the images of a place.
    """

    images: int
    rows: int
    columns: int
    grid: Pair
    steps: int
    chunks: int


def places(tiles: Tiles, images: int, count: int, others: int, programs: int) -> Places:
    """Shares tiles among programs: those at once leave the fewest idle, and are rather of one image and one row.

    Args:
        tiles: what is computed.
        images: B.
        count: tiles at once, a power of two.
        others: programs for each place and each chunk.
        programs: to have about as many or more, if there are enough images.
    """
    sides = [-(-length // side) for length, side in zip(tiles.written, tiles.tile, strict=False)]
    powers = [2**i for i in range(count.bit_length())]
    options = [(count // (rows * columns), rows, columns) for rows in powers for columns in powers]

    def cost(option: tuple[int, int, int]) -> tuple[int, int, int]:
        covered = math.prod(-(-n // at_once) * at_once for n, at_once in zip((images, *sides), option, strict=True))
        return covered, option[0], -option[2]

    at_once, rows, columns = min((option for option in options if option[0]), key=cost)
    grid = -(-sides[0] // rows), -(-sides[1] // columns)
    steps = -(-images // at_once)
    enough = min(steps, -(-programs // (others * math.prod(grid))))
    even = [n for n in range(enough, 2 * enough) if steps % n == 0]
    chunks = even[0] if even else -(-steps // (-(-steps // enough)))
    return Places(at_once, rows, columns, grid, -(-steps // chunks), chunks)
