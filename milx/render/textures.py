"""Solid textures: at every point of a thing, how much it shows of a second color.

A texture is a function of the place in the thing's own frame, so that it turns with the thing and has no seams. Every
family repeats with a period of about 1 in each direction; a texture's frame scales, turns and shifts it. What is held
out is a family, not another size of one that was trained on.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from milx.render.raycast import Vector, dot

PERIOD = (0.015, 0.045)
"""Of a texture (m), drawn uniformly."""
_TURN = 2 * math.pi
# Coefficients of sin(2 pi x) in powers of x, from the ninth to the first.
_SINE = tuple((-1) ** (k // 2) * _TURN**k / math.factorial(k) for k in (9, 7, 5, 3, 1))
# Directions and phases of the waves that add up to noise.
_WAVES = ((0.9, 0.4, 0.2, 0.0), (-0.5, 0.8, 0.5, 1.3), (0.3, -0.7, 0.9, 2.9), (1.4, 1.1, -0.8, 4.4))


class Textures(NamedTuple):
    """Textures of geoms; leading axes may stand in front.

    Attributes:
        family: int32, index into FAMILIES.
        rgb: [3] the second color, in [0, 1].
        frame: [3, 4] linear part and offset of the map from meters, in the thing's frame or the world's, to the
            family's units.
    """

    family: jax.Array
    rgb: jax.Array
    frame: jax.Array


def _saw(x: jax.Array) -> jax.Array:
    """Computes the signed distance from the nearest whole number, of period 1."""
    return x - jnp.floor(x + 0.5)


def _wave(x: jax.Array) -> jax.Array:
    """Evaluates sin(2 pi x) by its Taylor series of the ninth order within a quarter of a period of 0, to 4e-6.

    What rounding x - 1/4 costs is added to that, 2e-5 where x is 100. On CPUs XLA's own sine takes ten times as long:
    with it textures took most of the time of an image.
    """
    near = 0.25 - jnp.abs(_saw(x - 0.25))  # sin(2 pi x) = sin(2 pi near), and near is in [-1/4, 1/4]
    square = near * near
    total = jnp.zeros_like(x)
    for coefficient in _SINE:
        total = total * square + coefficient
    return total * near


def _edge(x: jax.Array, sharpness: float) -> jax.Array:
    """Rises from 0 to 1 where x passes through 0."""
    return jnp.clip(0.5 + sharpness * x, 0.0, 1.0)


def _noise(p: Vector) -> jax.Array:
    """Sums waves in directions without a common period, each bent by the one before."""
    total = bend = jnp.zeros_like(p[0])
    for x, y, z, phase in _WAVES:
        bend = _wave((4 * (x * p[0] + y * p[1] + z * p[2]) + phase + 1.5 * bend) / _TURN)
        total = total + bend / len(_WAVES)
    return total


def _bricks(p: Vector) -> jax.Array:
    """Rows of 2 x 1, each shifted by half a brick, with joints of the second color."""
    row = jnp.floor(p[1] + 0.5)
    joint = jnp.maximum(jnp.abs(_saw(p[1])), 2 * jnp.abs(_saw(p[0] / 2 + row / 2)) - 0.5)
    return _edge(joint - 0.38, 12)


FAMILIES: dict[str, Callable[[Vector], jax.Array]] = {
    "plain": lambda p: jnp.zeros_like(p[0]),
    "stripes": lambda p: _edge(_wave(p[0]), 4),
    "checks": lambda p: _edge(_wave(p[0]) * _wave(p[1]) * _wave(p[2]), 8),
    "dots": lambda p: _edge(0.14 - (_saw(p[0]) ** 2 + _saw(p[1]) ** 2 + _saw(p[2]) ** 2), 20),
    "noise": lambda p: _edge(_noise(p), 2),
    "marble": lambda p: _edge(_wave(p[0] + 0.8 * _noise(p)), 1),
    "waves": lambda p: _edge(_wave(p[0] + 0.3 * _wave(p[1] / 2)), 4),
    "plaid": lambda p: 0.5 * _edge(_wave(p[0]), 4) + 0.5 * _edge(_wave(p[1]), 4),
    "rings": lambda p: _edge(_wave(jnp.sqrt(p[0] * p[0] + p[1] * p[1] + 1e-6)), 4),
    "bricks": _bricks,
    "zigzag": lambda p: _edge(_wave(p[0] + 2 * jnp.abs(_saw(p[1] / 2))), 4),
}
"""How much of the second color shows, in [0, 1], from places in the family's units."""

BY_SPLIT: dict[str, tuple[str, ...]] = {
    "train": ("plain", "stripes", "checks", "dots", "noise", "marble"),
    "validation": ("waves", "plaid"),
    "test": ("rings", "bricks", "zigzag"),
}
"""The names of every split's families. From a family there are as many textures as there are frames and colors."""


def _draw_turn(key: jax.Array) -> jax.Array:
    """Samples a rotation matrix uniformly: makes two random vectors orthonormal and adds the third axis."""
    first, second = jax.random.normal(key, (2, 3))
    x = first / jnp.linalg.norm(first)
    normal = jnp.cross(x, second)
    z = normal / jnp.linalg.norm(normal)
    return jnp.stack([x, jnp.cross(z, x), z])


def draw(key: jax.Array, split: str) -> Textures:
    """Samples a texture of a split's (a key of BY_SPLIT) families, with any size, rotation, shift and color."""
    names = list(FAMILIES)
    family_key, turn_key, period_key, shift_key, color_key = jax.random.split(key, 5)
    family = jax.random.choice(family_key, jnp.array([names.index(name) for name in BY_SPLIT[split]]))
    turn = _draw_turn(turn_key)
    period = jax.random.uniform(period_key, minval=PERIOD[0], maxval=PERIOD[1])
    shift = jax.random.uniform(shift_key, (3, 1))
    return Textures(family, jax.random.uniform(color_key, (3,)), jnp.concatenate([turn / period, shift], axis=1))


def draw_looks(key: jax.Array, split: str, count: int) -> dict[str, Any]:
    """Samples a "color" [N, 3], RGB in [0, 1], and a "texture" [N] for each of N = `count` bodies of a task."""
    color_key, texture_key = jax.random.split(key)
    texture = jax.vmap(functools.partial(draw, split=split))(jax.random.split(texture_key, count))
    return {"color": jax.random.uniform(color_key, (count, 3)), "texture": texture}


def seen_from(frame: jax.Array, xpos: jax.Array, xmat: jax.Array) -> jax.Array:
    """Composes the map [..., 3, 4] for positions in a frame with origin `xpos` whose axes are the columns of `xmat`."""
    high = jax.lax.Precision.HIGHEST
    linear = jnp.matmul(frame[..., :3], xmat, precision=high)
    offset = jnp.einsum("...ij,...j->...i", frame[..., :3], xpos, precision=high) + frame[..., 3]
    return jnp.concatenate([linear, offset[..., None]], axis=-1)


def on_geoms(
    texture: Textures, body: np.ndarray, geom_bodyid: np.ndarray, xpos: jax.Array, xmat: jax.Array
) -> Textures:
    """Assigns textures to all G geoms of a model, with frames that take the world's; geoms of other bodies are plain.

    Args:
        texture: of some bodies, with frames that take the body's.
        body: static, the ids of those bodies.
        geom_bodyid: [G] static, the body of each geom.
        xpos: [..., 3] of all bodies (m).
        xmat: [..., 3, 3] of all bodies.
    """
    posed = texture._replace(frame=in_world(texture.frame, xpos[body], xmat[body]))
    owner = (geom_bodyid[:, None] == body).argmax(axis=1)
    worn = jax.tree.map(lambda x: x[owner], posed)
    return worn._replace(family=jnp.where(np.isin(geom_bodyid, body), worn.family, 0))


def in_world(frame: jax.Array, xpos: jax.Array, xmat: jax.Array) -> jax.Array:
    """Composes the map for positions in the world, where `frame` takes those of a body at this pose: [..., 3, 4]."""
    back = jnp.swapaxes(xmat, -1, -2)
    origin = -jnp.einsum("...ij,...j->...i", back, xpos, precision=jax.lax.Precision.HIGHEST)
    return seen_from(frame, origin, back)


def mix(rgb: Vector, family: jax.Array, second: Vector, rows: tuple[Vector, ...], point: Vector) -> Vector:
    """Computes the color at each point, three [P] arrays.

    Args:
        rgb: first color, three [P] arrays.
        family: [P], as any type of number.
        second: second color.
        rows: [3][4][P] map from the points to the family's units.
        point: three [P] arrays.
    """
    place = tuple(row[3] + dot(row[:3], point) for row in rows)
    weight = jnp.zeros_like(place[0])
    for i, show in enumerate(FAMILIES.values()):
        weight = jnp.where(family == i, show(place), weight)
    return tuple(a + weight * (b - a) for a, b in zip(rgb, second, strict=True))
