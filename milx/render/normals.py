"""The surface where a ray arrives: unit normals of the shapes of `raycast.py`, and texture coordinates of meshes.

A normal is a gradient, which the transposed map of a geom carries back into the camera frame.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from milx.render import meshes
from milx.render.meshes import Meshes
from milx.render.raycast import TINY, Kind, UnitMaps, Vector, dot

_SEEN = 0.999
"""From which fraction of its depth on a point may lie again on the triangle on which it has been seen."""


def at_points(
    groups: Mapping[Kind, np.ndarray],
    maps: UnitMaps,
    geom_id: jax.Array,
    point: Vector,
    triangles: Meshes | None = None,
) -> tuple[Vector, Vector | None]:
    """Computes the unit normals of the surfaces, three [P] arrays in the camera frame, and texture coordinates.

    Args:
        groups: static geom ids by kind.
        maps: of all geoms.
        geom_id: [P] int32, the geom that each point lies on. Any point gives finite values.
        point: three [P] arrays, m, in the camera frame. On a mesh it must be what the camera sees of it.
        triangles: of the meshes; None if there is none.

    Returns:
        The normals; and s and t, two [P] arrays that mean something on meshes alone, or None if there is none.
    """
    kind_of_geom = np.zeros(maps.stretch.shape, np.int32)
    for kind, ids in groups.items():
        kind_of_geom[ids] = kind
    kinds = jnp.asarray(kind_of_geom)[geom_id]
    entries = maps.affine.reshape(-1, 12)[geom_id]
    rows = tuple(tuple(entries[:, 4 * i + j] for j in range(4)) for i in range(3))
    facing = texcoord = None
    if triangles is not None:  # the way from the camera to the point leads to the triangle
        root = jnp.where(kinds == Kind.MESH, jnp.asarray(triangles.root)[geom_id], len(triangles.skip))
        ray = tuple(dot(row[:3], point) for row in rows)
        eye = tuple(row[3] for row in rows)
        _, seen = meshes.meet(triangles, root, eye, ray, _SEEN)
        facing, texcoord = meshes.surface(triangles, seen, eye, ray)
    return surface_normal(kinds, rows, maps.stretch[geom_id], point, facing), texcoord


def surface_normal(
    kind: jax.Array, rows: tuple[Vector, ...], stretch: jax.Array, point: Vector, facing: Vector | None = None
) -> Vector:
    """Computes unit normals at points on geoms of these kinds and maps, all of which are arrays over the points.

    `facing` is the direction, in the geom's frame, in which a mesh faces at its points.
    """
    local = tuple(row[3] + dot(row[:3], point) for row in rows)
    gradient = _gradient(kind, stretch, local)
    if facing is not None:
        gradient = tuple(jnp.where(kind == Kind.MESH, a, b) for a, b in zip(facing, gradient, strict=True))
    normal = tuple(dot(column, gradient) for column in tuple(zip(*rows, strict=True))[:3])
    inverse = jax.lax.rsqrt(jnp.maximum(dot(normal, normal), TINY))
    return tuple(inverse * component for component in normal)


def _gradient(kind: jax.Array, stretch: jax.Array, point: Vector) -> Vector:
    """Computes the direction in which a unit shape's implicit function grows fastest, at a point of its surface."""
    x, y, z = point
    # The faceted shapes: outwards on the face that the point is farthest out along.
    on_side = jnp.abs(z) < jnp.where(kind == Kind.BOX, jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.sqrt(x * x + y * y))
    skip_x = (kind == Kind.BOX) & (jnp.abs(x) < jnp.abs(y))
    skip_y = (kind == Kind.BOX) & ~skip_x
    faceted = (jnp.where(on_side & ~skip_x, x, 0.0), jnp.where(on_side & ~skip_y, y, 0.0), jnp.where(on_side, 0.0, z))
    # The round shapes: away from the nearest point of the core, which is the center or a capsule's axis.
    core = jnp.where(kind == Kind.CAPSULE, jnp.clip(z, -stretch, stretch), 0.0)
    solid = (jnp.where(kind >= Kind.CYLINDER, a, b) for a, b in zip(faceted, (x, y, z - core), strict=True))
    return tuple(jnp.where(kind == Kind.PLANE, a, b) for a, b in zip((0.0, 0.0, 1.0), solid, strict=True))
