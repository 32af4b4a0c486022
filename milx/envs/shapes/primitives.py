"""Shapes of things on a table, built of a few primitives each.

A shape lies on horizontal capsules, some of no length: they are what others touch. Ellipsoids, boxes and upright
cylinders stand on them and are only seen; from above they hardly reach beyond the capsules' outline. Lengths are in
any unit; the origin is anywhere, x and y are on the table and z is the height above it.

Every task has the same geoms (SLOTS): what a shape does not use is hidden.
"""

import dataclasses
import functools
import itertools
from typing import NamedTuple

import numpy as np

SLOTS = {"capsule": 4, "ellipsoid": 3, "box": 2, "cylinder": 4}
"""The most primitives of each kind, by MuJoCo's names and in the order of a body's geoms."""
NUM_CAPSULES = SLOTS["capsule"]
_SPACING = 0.01
_HALF = 0.5**0.5
_SQUAT = 0.65


class Capsule(NamedTuple):
    """A capsule that lies on the table, from (x0, y0) to (x1, y1); `seen` is whether it is visible."""

    x0: float
    y0: float
    x1: float
    y1: float
    radius: float
    seen: bool = True


class Ellipsoid(NamedTuple):
    """An ellipsoid: center and half-axes."""

    x: float
    y: float
    z: float
    a: float
    b: float
    c: float


class Box(NamedTuple):
    """A box: center, half-lengths, and its turn about the vertical (rad)."""

    x: float
    y: float
    z: float
    a: float
    b: float
    c: float
    turn: float = 0.0


class Cylinder(NamedTuple):
    """An upright cylinder: center, radius and half-height."""

    x: float
    y: float
    z: float
    radius: float
    half: float


@dataclasses.dataclass(frozen=True)
class Shape:
    """What a thing looks like.

    Attributes:
        capsules, ellipsoids, boxes, cylinders: its primitives; at least one capsule.
    """

    capsules: tuple[Capsule, ...]
    ellipsoids: tuple[Ellipsoid, ...]
    boxes: tuple[Box, ...]
    cylinders: tuple[Cylinder, ...]


def shape(*primitives: Capsule | Ellipsoid | Box | Cylinder) -> Shape:
    """Builds a shape of these primitives.

    Raises:
        ValueError: for too many of a kind, or no capsule.
    """
    kinds: dict[type, tuple] = {
        kind: tuple(p for p in primitives if isinstance(p, kind)) for kind in (Capsule, Ellipsoid, Box, Cylinder)
    }
    for (kind, found), limit in zip(kinds.items(), SLOTS.values(), strict=True):
        if len(found) > limit:
            raise ValueError(f"shape: got {len(found)} of {kind.__name__}, expected at most {limit}")
    if not kinds[Capsule]:
        raise ValueError("shape: got no Capsule, expected at least one: nothing could touch it")
    return Shape(kinds[Capsule], kinds[Ellipsoid], kinds[Box], kinds[Cylinder])


def ball(x: float, y: float, radius: float) -> Capsule:
    """Makes a capsule of no length."""
    return Capsule(x, y, x, y, radius)


def strokes(text: str, radius: float = 0.22) -> Shape:
    """Draws capsules between points "x,y", as in "-1,-1 0,1 1,-1" for a roof; "|" lifts the pen."""
    capsules = []
    for line in text.split("|"):
        points = [[float(v) for v in point.split(",")] for point in line.split()]
        capsules += [Capsule(x0, y0, x1, y1, radius) for (x0, y0), (x1, y1) in itertools.pairwise(points)]
    return shape(*capsules)


def turned(*profile: tuple[str, float, float]) -> Shape:
    """Stacks ellipsoids and cylinders, (kind, radius, height) each, from the table upwards: a turned piece.

    All of them are squat, so that they hide little of what stands behind them.
    """
    z, primitives = 0.0, []
    for kind, radius, height in profile:
        half = _SQUAT * height / 2
        middle = z + half
        primitives.append(
            Cylinder(0, 0, middle, radius, half)
            if kind == "cylinder"
            else Ellipsoid(0, 0, middle, radius, radius, half)
        )
        z += 2 * half
    outline = max(radius for _, radius, _ in profile)
    return shape(Capsule(0, 0, 0, 0, outline, seen=False), *primitives)


class Geoms(NamedTuple):
    """A shape as geoms of a body whose origin is the center of the outline's area, on the table.

    P is the sum of SLOTS. The unit of length is the geometric mean of two radii: that of a disc of the outline's
    area, and the distance of its farthest point from the origin.

    Attributes:
        pos: [P, 3].
        quat: [P, 4].
        size: [P, 3], by MuJoCo's conventions for each kind.
        used: [P] bool, whether there is such a geom; the others are to be kept out of the way.
        seen: [P] bool, whether it is visible.
        squared_gyration: mean squared distance of the outline's area from the origin.
        ends: [NUM_CAPSULES, 2, 2] x and y of the capsules' ends; the first one stands in for those that are not used.
        radius: [NUM_CAPSULES] of the capsules.
    """

    pos: np.ndarray
    quat: np.ndarray
    size: np.ndarray
    used: np.ndarray
    seen: np.ndarray
    squared_gyration: float
    ends: np.ndarray
    radius: np.ndarray


@functools.cache
def to_geoms(shape: Shape) -> Geoms:
    """Builds the geoms of a shape, centered and scaled; they are shared and not to be changed."""
    center, squared_gyration, unit = _outline(shape.capsules)
    kinds: tuple[tuple, ...] = (shape.capsules, shape.ellipsoids, shape.boxes, shape.cylinders)
    rows: list[tuple[list[float], list[float], list[float], bool, bool]] = []
    for limit, primitives in zip(SLOTS.values(), kinds, strict=True):
        rows += [(*_to_geom(p), True, not isinstance(p, Capsule) or p.seen) for p in primitives]
        rows += [([0, 0, 0], [1, 0, 0, 0], [unit] * 3, False, False)] * (limit - len(primitives))
    pos, quat, size, used, seen = (np.array(column) for column in zip(*rows, strict=True))
    pos[used, :2] -= center
    ends, radius = _ends(shape.capsules + shape.capsules[:1] * (NUM_CAPSULES - len(shape.capsules)))
    squared_gyration /= unit**2
    return Geoms(pos / unit, quat, size / unit, used, seen, squared_gyration, (ends - center) / unit, radius / unit)


def _to_geom(p: Capsule | Ellipsoid | Box | Cylinder) -> tuple[list[float], list[float], list[float]]:
    """Returns the position, quaternion and size of a primitive."""
    upright = [1.0, 0.0, 0.0, 0.0]
    match p:
        case Capsule():
            dx, dy = p.x1 - p.x0, p.y1 - p.y0
            length = float(np.hypot(dx, dy))
            lying = [_HALF, -dy / length * _HALF, dx / length * _HALF, 0.0] if length else upright
            return [(p.x0 + p.x1) / 2, (p.y0 + p.y1) / 2, p.radius], lying, [p.radius, length / 2, 0.0]
        case Ellipsoid():
            return [p.x, p.y, p.z], upright, [p.a, p.b, p.c]
        case Box():
            return [p.x, p.y, p.z], [float(np.cos(p.turn / 2)), 0.0, 0.0, float(np.sin(p.turn / 2))], [p.a, p.b, p.c]
        case Cylinder():
            return [p.x, p.y, p.z], upright, [p.radius, p.half, 0.0]


def _ends(capsules: tuple[Capsule, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Returns ends [N, 2, 2] and radii [N] of N capsules."""
    ends = np.array([[[c.x0, c.y0], [c.x1, c.y1]] for c in capsules], float)
    return ends, np.array([c.radius for c in capsules])


def _outline(capsules: tuple[Capsule, ...]) -> tuple[np.ndarray, float, float]:
    """Returns the center [2] of the capsules' area, its mean squared distance from there, and the unit of length."""
    ends, radius = _ends(capsules)
    low, high = (ends.min(axis=(0, 1)) - radius.max(), ends.max(axis=(0, 1)) + radius.max())
    grid = np.stack(np.meshgrid(*(np.arange(a, b, _SPACING) for a, b in zip(low, high, strict=True))), axis=-1)
    covered = grid[(distance_to_outline(grid, ends, radius) <= 0)]
    center = covered.mean(axis=0)
    squared_gyration = float(np.square(covered - center).sum(axis=-1).mean())
    reach = (np.linalg.norm(ends - center, axis=-1).max(axis=-1) + radius).max()
    disc = (len(covered) * _SPACING**2 / np.pi) ** 0.5
    return center, squared_gyration, float((reach * disc) ** 0.5)


def distance_to_outline(points: np.ndarray, ends: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Computes [...] signed distances of points [..., 2] to the union of capsules with ends [N, 2, 2] and radii [N]."""
    along = ends[:, 1] - ends[:, 0]
    offset = points[..., None, :] - ends[:, 0]
    t = np.clip((offset * along).sum(axis=-1) / np.maximum(np.square(along).sum(axis=-1), 1e-12), 0, 1)
    return (np.linalg.norm(offset - t[..., None] * along, axis=-1) - radius).min(axis=-1)
