"""Which pixels meet at which tap of a kernel, and which program computes which tile: every one once."""

import itertools
from collections import Counter

import pytest

from milx.meta.convolution import same_padding
from milx.meta.tiles import Geometry, of_inputs, of_outputs, places

# Length of an axis, taps and stride.
AXES = [(9, 5, 2), (10, 5, 2), (7, 3, 1), (8, 3, 3), (8, 2, 3), (5, 1, 1), (125, 5, 2)]


def make_geometry(length, taps, stride):
    before, shape = same_padding(length, taps, stride)[0], -(-length // stride)
    return Geometry(stride, taps, (before, before), (length, length), (shape, shape))


def meetings(tiles, taps):
    """Counts the pixels that are read and written together, with the tap, along rows."""
    found = Counter()
    for number in range(-(-tiles.written[0] // tiles.tile[0])):
        for d, r in itertools.product(range(tiles.window[0]), range(tiles.tile[0])):
            read, written = number * tiles.step[0] - tiles.before[0] + d, number * tiles.tile[0] + r
            tap = tiles.lines[0].at(d, r)
            if 0 <= tap < taps and 0 <= read < tiles.read[0] and written < tiles.written[0]:
                found[read, written, tap] += 1
    return found


@pytest.mark.parametrize(("length", "taps", "stride"), AXES)
def test_pixels_meet_where_the_convolution_says(length, taps, stride):
    """Lists all s p + i - a in the image, for tiles of one, two and three outputs and for those of inputs."""
    geometry = make_geometry(length, taps, stride)
    pairs = itertools.product(range(geometry.shape[0]), range(taps))
    pixels = ((stride * p + i - geometry.before[0], p, i) for p, i in pairs)
    expected = Counter(pixel for pixel in pixels if 0 <= pixel[0] < length)
    for count in (1, 2, 3):
        assert meetings(of_outputs(geometry, 4, 5, (count, count), 2), taps) == expected
    inputs = meetings(of_inputs(geometry, 4, 5), taps)
    assert inputs == Counter((pixel, p, i) for p, pixel, i in expected)


def test_windows_of_four_channels_are_as_wide_as_vectors_of_16_bytes():
    geometry = make_geometry(9, 5, 2)
    assert [of_outputs(geometry, 4, 5, (1, 2), size).window for size in (2, 4, 8)] == [(5, 8), (5, 7), (5, 7)]


@pytest.mark.parametrize("count", [16, 128])
@pytest.mark.parametrize(
    ("images", "length", "programs"), [(7, 9, 1), (100, 63, 500), (97, 63, 500), (12, 16, 30), (1, 4, 99)]
)
def test_every_tile_of_every_image_has_one_program(images, length, programs, count):
    tiles = of_outputs(make_geometry(length, 3, 2), 4, 5, (1, 2), 2)
    found = places(tiles, images, count, 2, programs)
    assert found.images * found.rows * found.columns == count
    sides = [-(-n // m) for n, m in zip(tiles.written, tiles.tile, strict=False)]
    for side, at_once, many in zip(sides, (found.rows, found.columns), found.grid, strict=True):
        assert (many - 1) * at_once < side <= many * at_once
    groups = -(-images // found.images)
    assert found.steps * (found.chunks - 1) < groups <= found.steps * found.chunks
    there = 2 * found.grid[0] * found.grid[1]
    enough = min(groups, -(-programs // there))
    assert enough / 2 <= found.chunks < 2 * enough


def test_tiles_at_once_leave_none_idle_where_they_fit():
    tiles = of_outputs(make_geometry(16, 3, 2), 4, 5, (1, 2), 2)  # 8 x 4 tiles of an image
    found = places(tiles, 100, 128, 1, 1)
    assert (found.images, found.rows, found.columns, found.grid) == (4, 8, 4, (1, 1))
