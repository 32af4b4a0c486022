"""Containers: open vessels of straight walls, which a held thing is dropped into.

A container stands on the table with its origin in the middle of its bottom. Its walls are boxes on the sides of a
regular polygon, stretched along x if it is longer than wide, and leaning outwards if it is wider at the top. What falls
meets the walls and the table; bottoms, handles and feet are only seen. The unit of length is half its width at the top.

What is held out is a kind of container, not another size of one that was trained on.
"""

import dataclasses
import functools
import itertools
from typing import NamedTuple

import numpy as np

WALLS = 8
"""The most walls of a container, the first geoms of its body."""
SLOTS = {"box": WALLS + 1, "ellipsoid": 1, "capsule": 2}
"""Geoms of every container, by MuJoCo's names and in the order of its body's: walls and a bottom, a bottom, handles."""
_BOTTOM = 0.03


@dataclasses.dataclass(frozen=True)
class Container:
    """What a container looks like.

    Attributes:
        sides: walls in a polygon; WALLS for a round one.
        height: of the rim.
        bottom: half its width at the bottom.
        length: its length divided by its width.
        wall: thickness of its walls.
        handles: none, one or two, along x.
        handle: how far they stick out.
        handle_height: where, between 0 for the table and 1 for the rim.
    """

    sides: int
    height: float
    bottom: float = 1.0
    length: float = 1.0
    wall: float = 0.08
    handles: int = 0
    handle: float = 0.35
    handle_height: float = 0.7


def _round(height: float, bottom: float = 1.0, **more: float) -> Container:
    return Container(WALLS, height, bottom, **more)  # type: ignore[arg-type]


def _square(height: float, bottom: float = 1.0, **more: float) -> Container:
    return Container(4, height, bottom, **more)  # type: ignore[arg-type]


def _hexagon(height: float, bottom: float = 1.0, **more: float) -> Container:
    return Container(6, height, bottom, **more)  # type: ignore[arg-type]


CONTAINERS: dict[str, Container] = {
    "bowl": _round(0.7, 0.45),
    "plate": _round(0.16, 0.7),
    "cup": _round(1.0, 0.75),
    "bucket": _round(1.25, 0.7, wall=0.05),
    "pot": _round(0.75, handles=2),
    "frying_pan": _round(0.3, 0.85, handles=1, handle=1.1, handle_height=0.9),
    "basin": _round(0.45, 0.75, wall=0.12),
    "tin": _round(1.1, wall=0.05),
    "cake_mould": _round(0.4, wall=0.05),
    "flowerpot": _round(1.0, 0.6, wall=0.14),
    "round_basket": _round(0.6, 0.8, wall=0.14, handles=2, handle=0.2),
    "ashtray": _round(0.28, 1.0, wall=0.25),
    "box": _square(0.8),
    "crate": _square(0.6, length=1.3, wall=0.14),
    "baking_tray": _square(0.16, length=1.35, wall=0.05),
    "serving_tray": _square(0.22, length=1.3, handles=2, handle=0.2),
    "punnet": _square(0.5, 0.75, length=1.25, wall=0.05),
    "carton": _square(1.15, wall=0.04),
    "trough": _square(0.45, 0.6, length=1.6),
    "drawer": _square(0.4, length=1.2, wall=0.1, handles=1, handle=0.15, handle_height=0.5),
    "waste_bin": _square(1.3, 0.75, wall=0.05),
    "hexagonal_box": _hexagon(0.7),
    "hexagonal_plate": _hexagon(0.16, 0.75),
    "hexagonal_planter": _hexagon(0.95, 0.65, wall=0.14),
    # Validation.
    "wok": _round(0.5, 0.3, handles=2),
    "saucer": _round(0.2, 0.45),
    "jar": _round(1.4, wall=0.1),
    "tool_tray": _square(0.35, 0.85, length=1.5, handles=2, handle=0.3),
    "letter_tray": _square(0.25, length=1.2, wall=0.04),
    "hexagonal_basket": _hexagon(0.5, 0.8, wall=0.12, handles=2, handle=0.2),
    # Test.
    "mug": _round(1.1, handles=1),
    "soup_plate": _round(0.32, 0.6),
    "casserole": _round(0.6, wall=0.14, handles=2, handle=0.3, handle_height=0.9),
    "saucepan": _round(0.65, handles=1, handle=1.0, handle_height=0.9),
    "laundry_basket": _round(1.15, 0.85, wall=0.12, handles=2, handle=0.15, handle_height=0.95),
    "mortar": _round(0.8, 0.6, wall=0.3),
    "oval_dish": _round(0.35, 0.8, length=1.45),
    "oval_tub": _round(0.7, 0.85, length=1.35, handles=2),
    "oval_platter": _round(0.16, 0.7, length=1.4),
    "lunch_box": _square(0.5, length=1.4, handles=1, handle=0.15),
    "toolbox": _square(0.75, length=1.5, wall=0.06),
    "shopping_basket": _square(0.75, 0.75, length=1.3, wall=0.05, handles=2, handle=0.12, handle_height=1.0),
    "square_plate": _square(0.16, 0.75),
    "sandbox": _square(0.22, wall=0.22),
    "planter_box": _square(0.6, 0.9, length=1.6, wall=0.14),
    "umbrella_stand": _square(1.5, wall=0.08),
    "hexagonal_dish": _hexagon(0.35, 0.7, length=1.3),
    "hexagonal_bin": _hexagon(1.2, 0.8, wall=0.05),
}
"""All containers by name. A line adds one."""

_NAMES = tuple(CONTAINERS)
BY_SPLIT: dict[str, tuple[str, ...]] = {
    "train": _NAMES[: _NAMES.index("wok")],
    "validation": _NAMES[_NAMES.index("wok") : _NAMES.index("mug")],
    "test": _NAMES[_NAMES.index("mug") :],
}
"""The names of every split's containers."""


class Geoms(NamedTuple):
    """A container as geoms of a body that stands on the table; P is the sum of SLOTS.

    Attributes:
        pos: [P, 3].
        quat: [P, 4].
        size: [P, 3], by MuJoCo's conventions for each kind.
        used: [P] bool, whether there is such a geom; the others are to be kept out of the way.
        half: [2] half its length and width at the rim.
        round: whether the rim is an ellipse rather than a rectangle.
        height: of the rim.
    """

    pos: np.ndarray
    quat: np.ndarray
    size: np.ndarray
    used: np.ndarray
    half: np.ndarray
    round: bool
    height: float


@functools.cache
def to_geoms(container: Container) -> Geoms:
    """Builds the geoms of a container; they are shared and not to be changed.

    Raises:
        ValueError: for a number of sides or handles that there are no geoms for.
    """
    if not 3 <= container.sides <= WALLS:
        raise ValueError(f"sides: got {container.sides}, expected 3 to {WALLS}")
    if not 0 <= container.handles <= SLOTS["capsule"]:
        raise ValueError(f"handles: got {container.handles}, expected 0 to {SLOTS['capsule']}")
    unused = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.1, 0.1, 0.1), False)
    polygonal = container.sides <= 4
    walls = _walls(container)
    length, width, half = container.length * container.bottom, container.bottom, _BOTTOM / 2
    floor = ((0.0, 0.0, half), (1.0, 0.0, 0.0, 0.0))
    box = (*floor, (length, width, half), True) if polygonal else unused
    # Between the polygon's inner and outer circle: walls hide what sticks out.
    spread = np.cos(np.pi / container.sides) ** -0.5
    disc = unused if polygonal else (*floor, (spread * length, spread * width, half), True)
    rows = [*walls, *[unused] * (WALLS - len(walls)), box, disc, *_handles(container)]
    rows += [unused] * (sum(SLOTS.values()) - len(rows))
    pos, quat, size, used = (np.array(column) for column in zip(*rows, strict=True))
    rim = np.array([container.length, 1.0])
    return Geoms(pos, quat, size, used, rim, not polygonal, container.height)


def _walls(container: Container) -> list[tuple]:
    """Places boxes on the sides of the polygon, leaning so that they meet its bottom and its rim; x is along each."""
    rows, angle = [], 2 * np.pi * (np.arange(container.sides + 1) + 0.5) / container.sides
    corner = np.stack([np.cos(angle), np.sin(angle)], axis=1) / np.cos(np.pi / container.sides)
    corner[:, 0] *= container.length
    for here, there in itertools.pairwise(corner):
        along = there - here
        middle, length = (here + there) / 2, float(np.linalg.norm(along))
        outwards = np.array([along[1], -along[0]]) / length
        spread = (1 - container.bottom) * float(middle @ outwards)
        slant = float(np.hypot(spread, container.height))
        # Their outer faces make the rim.
        place = middle - outwards * (spread + container.wall) / 2
        turn, lean = float(np.arctan2(along[1], along[0])), float(np.arctan2(spread, container.height))
        cos, sin, up, over = np.cos(turn / 2), np.sin(turn / 2), np.cos(lean / 2), np.sin(lean / 2)
        quat = (cos * up, cos * over, sin * over, sin * up)
        size = (length / 2, container.wall / 2, slant / 2)
        rows.append(((*place, container.height / 2), quat, size, True))
    return rows


def _handles(container: Container) -> list[tuple]:
    """Places capsules that lie along x."""
    radius, lying = 0.06, (0.5**0.5, 0.0, 0.5**0.5, 0.0)
    reach = container.length + container.handle / 2
    height = max(container.handle_height * container.height, radius)
    return [
        ((side * reach, 0.0, height), lying, (radius, container.handle / 2, 0.0), True)
        for side in (1.0, -1.0)[: container.handles]
    ]
