"""The same image in one GPU kernel: rays, nearest hit and lighting of a tile of pixels, without leaving the registers.

The arithmetic is that of `raycast`, `meshes`, `normals` and `shade`, the readable reference; this file arranges it for
Pallas. A tile of pixels passes over every geom whose bounding ball lies outside the pyramid that the tile sees. Through
the hierarchy of a mesh its pixels go together: into every node that one of them enters.
"""

import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

from milx.render import meshes, normals, raycast, shade, textures
from milx.render.meshes import Meshes
from milx.render.raycast import Kind
from milx.render.textures import Textures

_TILE = 16  # pixels, in both directions
_WARPS = 4
_WORD = 32  # geoms whose bounding balls are looked at together
_SLACK = 1.001  # bounding balls are blown up by this, so that rounding never hides a geom

# Columns of the table of geoms.
_AFFINE, _STRETCH, _BALL, _KIND, _RGB, _MATERIAL, _ROOT = 0, 12, 13, 17, 18, 21, 24
_FAMILY, _SECOND, _FRAME = 25, 26, 29
# Columns of the table of lights: from and to of the vectors, then the two scalars.
_LIGHT = ((0, 3), (3, 6), (6, 9), (9, 12), (12, 16), (16, 19))
_CUTOFF, _EXPONENT = 19, 20


class View(NamedTuple):
    """What the camera sees: all static."""

    height: int
    width: int
    tangent: float  # of half the vertical field of view
    near: float  # m along the optical axis; nothing closer is seen
    far: float  # m; nothing farther is seen


def geom_table(
    geom_type: np.ndarray,
    geometry: tuple[jax.Array, ...],
    rgba: jax.Array,
    materials: np.ndarray,
    texture: Textures | None,
    triangles: Meshes | None,
) -> jax.Array:
    """Returns [G, 25], all that the kernel must know of every geom; with textures [G, 41].

    Args:
        geom_type: [G] static, MuJoCo's geom types.
        geometry: the other arguments of `raycast.unit_maps`.
        rgba: [G, 4] colors; where alpha is 0 the geom is passed over.
        materials: [G, 3] emission, specular and shininess.
        texture: [G] with frames that take the camera's, or none.
        triangles: the hierarchies of the meshes, or none.
    """
    maps = raycast.unit_maps(geom_type, *geometry)
    geom_xpos, _, geom_size, cam_xpos, cam_xmat = geometry
    center = jnp.matmul(geom_xpos - cam_xpos, cam_xmat, precision=jax.lax.Precision.HIGHEST)
    radius, root = bounding_radius(geom_type, geom_size), np.zeros(len(geom_type))
    if triangles is not None:
        is_mesh, root = geom_type == int(mujoco.mjtGeom.mjGEOM_MESH), triangles.root
        radius = jnp.where(is_mesh, jnp.asarray(triangles.radius, radius.dtype), radius)
    radius = jnp.where(rgba[:, 3] > 0, radius, -jnp.inf)
    kinds = np.array([raycast.KIND_OF_GEOM.get(int(kind), -1) for kind in geom_type])
    columns = [maps.affine.reshape(-1, 12), maps.stretch, center, radius, kinds, rgba[:, :3], materials, root]
    if texture is not None:
        columns += [texture.family, texture.rgb, texture.frame.reshape(-1, 12)]
    return jnp.column_stack([jnp.asarray(column, jnp.float32) for column in columns])


def bounding_radius(geom_type: np.ndarray, geom_size: jax.Array) -> jax.Array:
    """Returns [G] radii in m of a ball around the center of every geom; infinite for a plane, which may be."""
    geom = mujoco.mjtGeom
    x, y, _ = geom_size.T
    radius_of = {
        geom.mjGEOM_SPHERE: x,
        geom.mjGEOM_CAPSULE: x + y,
        geom.mjGEOM_ELLIPSOID: geom_size.max(axis=1),
        geom.mjGEOM_CYLINDER: jnp.hypot(x, y),
        geom.mjGEOM_BOX: jnp.linalg.norm(geom_size, axis=1),
    }
    return jnp.select([geom_type == int(kind) for kind in radius_of], list(radius_of.values()), jnp.inf)


def light_table(lights: shade.Lights) -> jax.Array:
    """Returns [L, 21], the fields of all lights one after the other."""
    return jnp.column_stack(lights).astype(jnp.float32)


def mesh_tables(triangles: Meshes) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns boxes [N, 6], skips and first triangles [N, 2] int32, and triangles with their normals [F, 18]."""
    sides = [x.reshape(len(x), 9) for x in (triangles.triangle, triangles.normal)]
    links = np.stack([triangles.skip, triangles.first], axis=1)
    return jnp.asarray(triangles.box, jnp.float32), jnp.asarray(links), jnp.asarray(np.hstack(sides), jnp.float32)


def paint(
    geoms: jax.Array,
    lights: jax.Array,
    ranges: dict[Kind, tuple[int, int]],
    view: View,
    triangles: Meshes | None = None,
    interpret: bool = False,
) -> jax.Array:
    """Draws a scene without shadows: an image [H, W, 3] uint8.

    Args:
        geoms: [G, ...] from `geom_table`, in any order that keeps each kind together.
        lights: [L, 21] from `light_table`.
        ranges: static, the first row of each kind and the row after its last.
        view: what the camera sees.
        triangles: the hierarchies of the meshes, or none.
        interpret: run on any device, slowly, for tests.
    """
    tables = () if triangles is None else mesh_tables(triangles)
    return pl.pallas_call(
        functools.partial(_paint_tile, ranges=ranges, view=view),
        out_shape=jax.ShapeDtypeStruct((view.height, view.width, 3), jnp.uint8),
        grid=(pl.cdiv(view.height, _TILE), pl.cdiv(view.width, _TILE)),
        compiler_params=triton.CompilerParams(num_warps=_WARPS),
        interpret=interpret,
        name="paint",
    )(geoms, lights, *tables)


def _by_words(ranges: dict[Kind, tuple[int, int]]) -> Iterator[tuple[Kind, int, int, int]]:
    """Cuts the ranges where a new word of bits begins: kind, word, first row and the row after the last."""
    for kind, (first, last) in ranges.items():
        while first < last:
            word = first // _WORD
            end = min(last, (word + 1) * _WORD)
            yield kind, word, first, end
            first = end


def _paint_tile(geoms, lights, *rest, ranges, view) -> None:
    *tables, image = rest
    top, left = pl.program_id(0) * _TILE, pl.program_id(1) * _TILE

    def ray(row, col):
        x = (2 * (col + 0.5) / view.width - 1) * (view.tangent * view.width / view.height)
        return x, (1 - 2 * (row + 0.5) / view.height) * view.tangent

    pixel = jnp.arange(_TILE * _TILE)
    row, col = top + pixel // _TILE, left + pixel % _TILE
    rays = (*ray(row.astype(jnp.float32), col.astype(jnp.float32)), -1.0)
    west, north = ray(top.astype(jnp.float32), left.astype(jnp.float32))
    east, south = ray((top + _TILE - 1).astype(jnp.float32), (left + _TILE - 1).astype(jnp.float32))

    def affine(geom, first=_AFFINE):
        return tuple(tuple(geoms[geom, first + 4 * i + j] for j in range(4)) for i in range(3))

    def in_sight(first):
        """Tells whose balls reach into the tile's pyramid, whose sides contain the camera: bit i for geom first + i."""
        number = jnp.arange(_WORD)
        geom = jnp.minimum(first + number, len(geoms) - 1)
        x, y, z, radius = (geoms[geom, _BALL + i] for i in range(4))
        sides = [(x + west * z, west), (-x - east * z, east), (-y - north * z, north), (y + south * z, south)]
        distances = [inside + _SLACK * radius * jnp.sqrt(1 + slope * slope) for inside, slope in sides]
        return jnp.sum(jnp.where(functools.reduce(jnp.minimum, distances) >= 0, 1 << number, 0))

    def nearest(t, geom, triangle, best):
        nearer = (t < best[0]) & (t > view.near) & (t < view.far)
        return tuple(jnp.where(nearer, new, old) for new, old in zip((t, geom, triangle), best, strict=True))

    def through(geom, best):
        """Goes through the hierarchy of the geom's mesh."""
        boxes, links, _ = tables
        rows, root = affine(geom), geoms[geom, _ROOT].astype(jnp.int32)
        o, d = tuple(row[3] for row in rows), tuple(raycast.dot(row[:3], rays) for row in rows)
        inverse = meshes.inverse_of(d)

        def visit(state):
            node, best = state
            enters, leaves = meshes.crosses(tuple(boxes[node, i] for i in range(6)), o, inverse)
            inside = (enters <= leaves) & (leaves >= view.near) & (enters < best[0])
            entered = jnp.max(inside.astype(jnp.int32)) > 0
            skip, first = links[node, 0], links[node, 1]

            def compare(best):
                for triangle in (first + number for number in range(meshes.LEAF)):
                    best = nearest(meshes.intersect(corners(triangle), o, d)[0], geom, triangle, best)
                return best

            best = jax.lax.cond(entered & (first >= 0), compare, lambda best: best, best)
            return jnp.where(entered & (first < 0), node + 1, skip), best

        return jax.lax.while_loop(lambda state: state[0] < links[root, 0], visit, (root, best))[1]

    def corners(triangle, first=0):
        """Reads a, u and v, or from 9 on the normals at the corners."""
        return tuple(tuple(tables[2][triangle, first + 3 * i + j] for j in range(3)) for i in range(3))

    best = (jnp.full(pixel.shape, jnp.inf, jnp.float32), *[jnp.zeros(pixel.shape, jnp.int32)] * 2)
    words = [in_sight(first) for first in range(0, len(geoms), _WORD)]
    for kind, word, first, last in _by_words(ranges):

        def closer(geom, best, kind=kind, word=word):
            def compare(best):
                if kind == Kind.MESH:
                    return through(geom, best)
                return nearest(raycast.enter(kind, affine(geom), geoms[geom, _STRETCH], None, rays), geom, 0, best)

            return jax.lax.cond((words[word] >> (geom - _WORD * word)) & 1 > 0, compare, lambda best: best, best)

        best = jax.lax.fori_loop(first, last, closer, best)

    distance, winner, seen = best
    hit = distance < jnp.inf
    point = tuple(jnp.where(hit, distance, 1.0) * x for x in rays)
    rows, faces = affine(winner), None
    if tables:
        o, d = tuple(row[3] for row in rows), tuple(raycast.dot(row[:3], point) for row in rows)
        faces, *_ = meshes.facing(corners(seen), corners(seen, 9), o, d)
    normal = normals.surface_normal(geoms[winner, _KIND], rows, geoms[winner, _STRETCH], point, faces)
    rgb = tuple(geoms[winner, _RGB + i] for i in range(3))
    if geoms.shape[1] > _FAMILY:
        second = tuple(geoms[winner, _SECOND + i] for i in range(3))
        rgb = textures.mix(rgb, geoms[winner, _FAMILY], second, affine(winner, _FRAME), point)
    material = shade.Material(rgb, *(geoms[winner, _MATERIAL + i] for i in range(3)))

    def field(light, first: int, last: int) -> Any:
        return tuple(lights[light, i] for i in range(first, last))

    def add(light, color):
        scalars = lights[light, _CUTOFF], lights[light, _EXPONENT]
        one = shade.Lights._make([*(field(light, *span) for span in _LIGHT), *scalars])
        return tuple(a + b for a, b in zip(color, shade.reflect(one, material, point, normal), strict=True))

    color = jax.lax.fori_loop(0, lights.shape[0], add, shade.emitted(material))
    inside = (row < view.height) & (col < view.width)
    for i, channel in enumerate(color):
        value = jnp.where(hit, 255 * jnp.clip(channel, 0.0, 1.0) + 0.5, 0.0).astype(jnp.uint8)
        triton.store(image.at[row, col, i], value, mask=inside)
