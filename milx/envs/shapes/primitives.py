"""Shapes of things on a table, built of a few primitives each.

A shape lies on *parts*, which are what others touch: sticks and balls of the same kind, since a ball is a stick of no
length. *Details* stand on the parts or between them, within their outline, and are only seen. Lengths are in units of
the thing's size; the origin is anywhere, x and y are on the table and z is the height above it.

A shape has at most NUM_STICKS sticks and balls, NUM_EGGS eggs, NUM_BOXES boxes and NUM_DRUMS drums: every task has the
same geoms, and what a shape does not use is hidden.
"""

import dataclasses
import itertools
from typing import NamedTuple

import numpy as np

NUM_STICKS, NUM_EGGS, NUM_BOXES, NUM_DRUMS = 4, 3, 2, 4
_FAR_BELOW = -10.0
_HALF = 0.5**0.5
_SQUAT = 0.65


class Stick(NamedTuple):
    """A capsule that lies on the table, from (x0, y0) to (x1, y1); `seen` is whether it is visible."""

    x0: float
    y0: float
    x1: float
    y1: float
    radius: float
    seen: bool = True


class Egg(NamedTuple):
    """An ellipsoid: centre and half-axes."""

    x: float
    y: float
    z: float
    a: float
    b: float
    c: float


class Box(NamedTuple):
    """A box: centre, half-lengths, and its turn about the vertical (rad)."""

    x: float
    y: float
    z: float
    a: float
    b: float
    c: float
    turn: float = 0.0


class Drum(NamedTuple):
    """An upright cylinder: centre, radius and half-height."""

    x: float
    y: float
    z: float
    radius: float
    half: float


@dataclasses.dataclass(frozen=True)
class Shape:
    """What a thing looks like.

    Attributes:
        sticks, eggs, boxes, drums: its primitives; at least one stick.
    """

    sticks: tuple[Stick, ...]
    eggs: tuple[Egg, ...]
    boxes: tuple[Box, ...]
    drums: tuple[Drum, ...]


def shape(*primitives: Stick | Egg | Box | Drum) -> Shape:
    """A shape of these primitives.

    Raises:
        ValueError: for too many of a kind, or no stick.
    """
    limits: dict[type, int] = {Stick: NUM_STICKS, Egg: NUM_EGGS, Box: NUM_BOXES, Drum: NUM_DRUMS}
    kinds = {kind: tuple(p for p in primitives if isinstance(p, kind)) for kind in limits}
    for kind, limit in limits.items():
        if len(kinds[kind]) > limit:
            raise ValueError(f"shape: got {len(kinds[kind])} of {kind.__name__}, expected at most {limit}")
    if not kinds[Stick]:
        raise ValueError("shape: got no Stick, expected at least one: nothing could touch it")
    return Shape(kinds[Stick], kinds[Egg], kinds[Box], kinds[Drum])  # type: ignore[arg-type]


def ball(x: float, y: float, radius: float) -> Stick:
    """A stick of no length."""
    return Stick(x, y, x, y, radius)


def strokes(text: str, radius: float = 0.22) -> Shape:
    """Sticks between points "x,y", as in "-1,-1 0,1 1,-1" for a roof; "|" lifts the pen."""
    sticks = []
    for line in text.split("|"):
        points = [[float(v) for v in point.split(",")] for point in line.split()]
        sticks += [Stick(x0, y0, x1, y1, radius) for (x0, y0), (x1, y1) in itertools.pairwise(points)]
    return shape(*sticks)


def turned(*profile: tuple[str, float, float]) -> Shape:
    """A turned piece: eggs and drums on each other, (kind, radius, height) each, from the table upwards.

    All of them are squat, so that they hide little of what stands behind them.
    """
    z, primitives = 0.0, []
    for kind, radius, height in profile:
        half = _SQUAT * height / 2
        middle = z + half
        primitives.append(
            Drum(0, 0, middle, radius, half) if kind == "drum" else Egg(0, 0, middle, radius, radius, half)
        )
        z += 2 * half
    outline = max(radius for _, radius, _ in profile)
    return shape(Stick(0, 0, 0, 0, outline, seen=False), *primitives)


class Geoms(NamedTuple):
    """A shape as geoms of a body whose origin is the centre of the outline's area, on the table.

    P = NUM_STICKS + NUM_EGGS + NUM_BOXES + NUM_DRUMS, in this order. The unit of length lies halfway (as a
    geometric mean) between the radius of a disc of the outline's area and the distance to its farthest point.

    Attributes:
        pos: [P, 3]; what is not used lies far below the table.
        quat: [P, 4].
        size: [P, 3], by MuJoCo's conventions for capsules, ellipsoids, boxes and cylinders.
        seen: [P] bool.
        gyration: mean squared distance of the outline's area from the origin.
    """

    pos: np.ndarray
    quat: np.ndarray
    size: np.ndarray
    seen: np.ndarray
    gyration: float


def geoms(shape: Shape) -> Geoms:
    """The geoms of a shape, centred and scaled."""
    centre, gyration, unit = _outline(shape.sticks)
    rows: list[tuple[list[float], list[float], list[float], bool]] = []
    for limit, primitives in (
        (NUM_STICKS, shape.sticks),
        (NUM_EGGS, shape.eggs),
        (NUM_BOXES, shape.boxes),
        (NUM_DRUMS, shape.drums),
    ):
        rows += [_geom(primitive) for primitive in primitives]
        rows += [([0, 0, _FAR_BELOW], [1, 0, 0, 0], [0.01] * 3, False)] * (limit - len(primitives))
    pos, quat, size, seen = (np.array(column) for column in zip(*rows, strict=True))
    used = pos[:, 2] != _FAR_BELOW
    pos[used, :2] -= centre
    return Geoms(pos / unit, quat, size / unit, seen, gyration / unit**2)


def _geom(p: Stick | Egg | Box | Drum) -> tuple[list[float], list[float], list[float], bool]:
    """Position, quaternion, size and visibility of a primitive."""
    if isinstance(p, Stick):
        dx, dy = p.x1 - p.x0, p.y1 - p.y0
        length = float(np.hypot(dx, dy))
        half_turn = [-dy / length * _HALF, dx / length * _HALF] if length else [0.0, 0.0]
        quat = [_HALF if length else 1.0, *half_turn, 0.0]
        return [(p.x0 + p.x1) / 2, (p.y0 + p.y1) / 2, p.radius], quat, [p.radius, length / 2, 0.0], p.seen
    upright = [1.0, 0.0, 0.0, 0.0]
    if isinstance(p, Box):
        turned = [float(np.cos(p.turn / 2)), 0.0, 0.0, float(np.sin(p.turn / 2))]
        return [p.x, p.y, p.z], turned, [p.a, p.b, p.c], True
    size = [p.a, p.b, p.c] if isinstance(p, Egg) else [p.radius, p.half, 0.0]
    return [p.x, p.y, p.z], upright, size, True


def _outline(sticks: tuple[Stick, ...], spacing: float = 0.01) -> tuple[np.ndarray, float, float]:
    """Centre [2] of the area that the sticks cover, its mean squared distance from there, and the unit of length."""
    ends = np.array([[[s.x0, s.y0], [s.x1, s.y1]] for s in sticks], float)
    radius = np.array([s.radius for s in sticks])
    low, high = (ends.min(axis=(0, 1)) - radius.max(), ends.max(axis=(0, 1)) + radius.max())
    grid = np.stack(np.meshgrid(*(np.arange(a, b, spacing) for a, b in zip(low, high, strict=True))), axis=-1)
    covered = grid[(distance_to_outline(grid, ends, radius) <= 0)]
    centre = covered.mean(axis=0)
    gyration = float(np.square(covered - centre).sum(axis=-1).mean())
    reach = (np.linalg.norm(ends - centre, axis=-1).max(axis=-1) + radius).max()
    disc = (len(covered) * spacing**2 / np.pi) ** 0.5
    return centre, gyration, float((reach * disc) ** 0.5)


def distance_to_outline(points: np.ndarray, ends: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """[...] signed distance of points [..., 2] to the union of sticks with ends [N, 2, 2] and radii [N]."""
    along = ends[:, 1] - ends[:, 0]
    offset = points[..., None, :] - ends[:, 0]
    t = np.clip((offset * along).sum(axis=-1) / np.maximum(np.square(along).sum(axis=-1), 1e-12), 0, 1)
    return (np.linalg.norm(offset - t[..., None] * along, axis=-1) - radius).min(axis=-1)
