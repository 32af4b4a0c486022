"""Ray casting: the nearest geom for every pixel.

An affine map takes the camera frame to each geom's own frame, scaled so that a sphere, an ellipsoid, a box, a cylinder
and a plane all become the unit shape of their kind; only the capsule keeps a parameter, its half-length in radii. A
distance along a ray is the same in every affine frame. Rays have unit length along the optical axis, so the distance
along a ray is the depth of the pixel.

Only the point where a ray enters a primitive counts, as in MuJoCo's renderer, which culls back faces: a camera inside a
geom sees out of it, a plane is seen from its front only, and no convex geom can throw a shadow on itself. The triangles
of meshes are seen from both sides (`meshes.py`).

`G` denotes the geoms and `P` the pixels. A vector per pixel is a tuple of three [P] arrays, so that XLA fuses the
arithmetic into loops over the pixels.
"""

import enum
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from milx.render import meshes
from milx.render.meshes import Meshes, Vector

# Divisors are kept this far from zero: a ray parallel to a face meets it very far away, and never at NaN.
TINY = 1e-12
# A shadow falls on a mesh from itself if it is at least this fraction of its diagonal away.
_OWN = 1e-3


class Kind(enum.IntEnum):
    """The unit shapes: every primitive MuJoCo geom is an affine image of one of them. Meshes are not scaled."""

    PLANE = 0  # |x|, |y| <= 1 and z = 0, seen from z > 0
    BALL = 1  # |p| <= 1
    CAPSULE = 2  # within 1 of the segment |z| <= stretch
    CYLINDER = 3  # x^2 + y^2 <= 1 and |z| <= 1
    BOX = 4  # |x|, |y|, |z| <= 1
    MESH = 5  # triangles, `meshes.py`


KIND_OF_GEOM = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): Kind.PLANE,
    int(mujoco.mjtGeom.mjGEOM_SPHERE): Kind.BALL,
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): Kind.BALL,
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): Kind.CAPSULE,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): Kind.CYLINDER,
    int(mujoco.mjtGeom.mjGEOM_BOX): Kind.BOX,
    int(mujoco.mjtGeom.mjGEOM_MESH): Kind.MESH,
}

# The columns of `geom_size` that scale each axis of the unit shape, by geom type; none along the normal of a plane.
_SCALE_COLUMNS = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): (0, 1, -1),
    int(mujoco.mjtGeom.mjGEOM_SPHERE): (0, 0, 0),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): (0, 1, 2),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): (0, 0, 0),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): (0, 0, 1),
    int(mujoco.mjtGeom.mjGEOM_BOX): (0, 1, 2),
}


class UnitMaps(NamedTuple):
    """Affine maps from the camera frame to the unit shapes."""

    affine: jax.Array  # [G, 3, 4] linear part and offset
    stretch: jax.Array  # [G] half-length of a capsule in radii; of no meaning for the other kinds


def dot(a: Vector, b: Vector) -> jax.Array:
    """Computes the inner product of two vectors."""
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=True):
        total = total + x * y
    return total


def unit_maps(
    geom_type: np.ndarray,
    geom_xpos: jax.Array,
    geom_xmat: jax.Array,
    geom_size: jax.Array,
    cam_xpos: jax.Array,
    cam_xmat: jax.Array,
) -> UnitMaps:
    """Maps that take the camera frame to the unit shape of every geom.

    Args:
        geom_type: [G] static, MuJoCo's geom types. Those without a unit shape get a map of no meaning.
        geom_xpos: [G, 3] m.
        geom_xmat: [G, 3, 3].
        geom_size: [G, 3] m, by MuJoCo's conventions.
        cam_xpos: [3] m.
        cam_xmat: [3, 3].
    """
    columns = np.array([_SCALE_COLUMNS.get(int(kind), (-1, -1, -1)) for kind in geom_type])
    scale = jnp.where(columns < 0, 1.0, jnp.take_along_axis(geom_size, jnp.maximum(columns, 0), axis=1))
    # A plane of size 0 is infinite: with an inverse scale of 0 every point of it lies within the unit square.
    inverse = jnp.where(scale > 0, 1 / jnp.where(scale > 0, scale, 1.0), 0.0)
    to_unit = inverse[:, :, None] * jnp.swapaxes(geom_xmat, 1, 2)
    high = jax.lax.Precision.HIGHEST  # accelerators would round the poses to half precision
    camera = jnp.broadcast_to(cam_xmat, geom_xmat.shape)
    relative = jnp.concatenate([camera, (cam_xpos - geom_xpos)[:, :, None]], axis=2)
    return UnitMaps(jnp.matmul(to_unit, relative, precision=high), geom_size[:, 1] * inverse[:, 0])


def rows_of(affine: jax.Array) -> tuple[Vector, ...]:
    """Splits an affine map [3, 4] into three rows of four scalars."""
    return tuple(tuple(row) for row in affine)


def enter(
    kind: Kind,
    rows: tuple[Vector, ...],
    stretch: jax.Array,
    start: Vector | None,
    ray: Vector,
    mesh: tuple[Meshes, jax.Array, jax.Array | float] | None = None,
) -> jax.Array:
    """Computes the distance at which rays enter one geom; infinite if they do not.

    Args:
        kind: of the geom.
        rows: its map, three rows of four.
        stretch: of its map.
        start: where the rays start, in the camera frame; None for the camera itself.
        ray: their directions in the camera frame.
        mesh: for a mesh, the hierarchies, where its own begins, and from which distance on it counts.
    """
    o = tuple(row[3] if start is None else row[3] + dot(row[:3], start) for row in rows)
    d = tuple(dot(row[:3], ray) for row in rows)
    if kind == Kind.MESH:
        assert mesh is not None
        table, root, least = mesh
        return meshes.meet(table, root, o, d, least)[0]
    return _ENTER[kind](o, d, stretch)


def _slab(o: jax.Array, d: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Computes the distances at which a ray enters and leaves |coordinate| <= 1."""
    inverse = 1 / jnp.where(jnp.abs(d) < TINY, TINY, d)
    middle = -o * inverse
    return middle - jnp.abs(inverse), middle + jnp.abs(inverse)


def _round(o: Vector, d: Vector) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Computes where a ray enters and leaves the unit ball (the disc, given two coordinates), and whether it does.

    Measured from the ray's closest point to the center, which keeps float32 accurate for small shapes far away, where
    the textbook discriminant cancels.
    """
    a = jnp.maximum(dot(d, d), TINY)
    middle = -dot(o, d) / a
    closest = tuple(x + middle * y for x, y in zip(o, d, strict=True))
    inside = 1 - dot(closest, closest)
    half = jnp.sqrt(jnp.maximum(inside, 0.0) / a)
    return middle - half, middle + half, inside >= 0


def _enter_plane(o: Vector, d: Vector, stretch: jax.Array) -> jax.Array:
    """Computes the distance to the front of the unit square."""
    t = -o[2] / jnp.minimum(d[2], -TINY)
    hit = (d[2] < 0) & (jnp.abs(o[0] + t * d[0]) <= 1) & (jnp.abs(o[1] + t * d[1]) <= 1)
    return jnp.where(hit, t, jnp.inf)


def _enter_ball(o: Vector, d: Vector, stretch: jax.Array) -> jax.Array:
    """Computes the distance to the unit ball."""
    t, _, hit = _round(o, d)
    return jnp.where(hit, t, jnp.inf)


def _enter_capsule(o: Vector, d: Vector, stretch: jax.Array) -> jax.Array:
    """Computes the distance to the capsule: its first point lies on the ball around the nearest point of its axis.

    That point of the axis is level with the entry into the infinite cylinder, or the end beyond which the entry lies.
    """
    side, _, near = _round(o[:2], d[:2])
    center = jnp.clip(o[2] + side * d[2], -stretch, stretch)
    t, _, hit = _round((o[0], o[1], o[2] - center), d)
    return jnp.where(near & hit, t, jnp.inf)


def _enter_cylinder(o: Vector, d: Vector, stretch: jax.Array) -> jax.Array:
    """Computes the distance to the cylinder, the part of an infinite cylinder that lies within a slab."""
    enter_side, leave_side, near = _round(o[:2], d[:2])
    enter_slab, leave_slab = _slab(o[2], d[2])
    t = jnp.maximum(enter_side, enter_slab)
    return jnp.where(near & (t <= jnp.minimum(leave_side, leave_slab)), t, jnp.inf)


def _enter_box(o: Vector, d: Vector, stretch: jax.Array) -> jax.Array:
    """Computes the distance to the box, the intersection of three slabs."""
    (x0, x1), (y0, y1), (z0, z1) = (_slab(o[i], d[i]) for i in range(3))
    t = jnp.maximum(jnp.maximum(x0, y0), z0)
    return jnp.where(t <= jnp.minimum(jnp.minimum(x1, y1), z1), t, jnp.inf)


_ENTER: Mapping[Kind, Callable[[Vector, Vector, jax.Array], jax.Array]] = {
    Kind.PLANE: _enter_plane,
    Kind.BALL: _enter_ball,
    Kind.CAPSULE: _enter_capsule,
    Kind.CYLINDER: _enter_cylinder,
    Kind.BOX: _enter_box,
}


def _select(maps: UnitMaps, ids: np.ndarray) -> UnitMaps:
    """Selects the maps of some geoms."""
    return UnitMaps(maps.affine[ids], maps.stretch[ids])


def nearest(
    groups: Mapping[Kind, np.ndarray],
    maps: UnitMaps,
    visible: jax.Array,
    rays: Vector,
    near: float,
    far: float,
    triangles: Meshes | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Finds the geom that each ray from the camera enters first.

    Bits of positive floats order as integers do. Distance and geom id therefore share one integer, the id in the lowest
    bits, and the search is a running minimum.

    Args:
        groups: static geom ids by kind, preferably the largest group last: XLA inlines a scan of length one into
            whatever uses its result, and computes it there again and again.
        maps: of all geoms.
        visible: [G] bool; the others are passed over.
        rays: three [P] arrays, directions in the camera frame with z = -1.
        near: m, nothing closer along the optical axis is seen.
        far: m, nothing farther is seen.
        triangles: of the meshes; None if there is none.

    Returns:
        (id [P] int32, -1 where nothing is hit; distance [P] m, infinite where nothing is hit). The bits lent to the id
        leave the distance short by less than one part in 2^22 / G in float32: 6e-6 for 23 geoms.
    """
    dtype = rays[0].dtype
    bits_of = {jnp.dtype("float32"): jnp.int32, jnp.dtype("float64"): jnp.int64}[dtype]
    infinite = np.array(np.inf, dtype).view(bits_of)
    id_mask = bits_of((1 << (maps.affine.shape[0] - 1).bit_length()) - 1)
    best = jnp.full(rays[0].shape, infinite | id_mask, bits_of)
    for kind, ids in groups.items():

        def closer(best, geom, kind=kind):
            to_unit, geom_id, shown = geom
            mesh = None
            if kind == Kind.MESH and triangles is not None:
                mesh = triangles, jnp.asarray(triangles.root)[geom_id], near
            t = enter(kind, rows_of(to_unit.affine), to_unit.stretch, None, rays, mesh)
            bits = (jax.lax.bitcast_convert_type(t, bits_of) & ~id_mask) | geom_id
            return jnp.where(shown & (t > near) & (t < far), jnp.minimum(best, bits), best), None

        best, _ = jax.lax.scan(closer, best, (_select(maps, ids), jnp.asarray(ids, bits_of), visible[ids]))
    hit = best < infinite
    distance = jax.lax.bitcast_convert_type(best & ~id_mask, dtype)
    return jnp.where(hit, best & id_mask, -1).astype(jnp.int32), jnp.where(hit, distance, jnp.inf)


def blocked(
    groups: Mapping[Kind, np.ndarray],
    maps: UnitMaps,
    visible: jax.Array,
    start: Vector,
    ray: Vector,
    reach: jax.Array | float,
    triangles: Meshes | None = None,
) -> jax.Array:
    """Tells whether any geom stands in the way: [P] bool.

    Args:
        groups: static geom ids by kind.
        maps: of all geoms.
        visible: [G] bool; the others are passed over.
        start: three [P] arrays, where the rays start, in the camera frame.
        ray: three [P] arrays or scalars, their directions.
        reach: how far to look, in lengths of `ray`.
        triangles: of the meshes; None if there is none.
    """
    found = jnp.zeros(start[0].shape, bool)
    for kind, ids in groups.items():

        def meets(found, geom, kind=kind):
            to_unit, geom_id, shown = geom
            mesh = None
            if kind == Kind.MESH and triangles is not None:  # rays that start on a mesh must not meet it there
                root = jnp.asarray(triangles.root)[geom_id]
                box = jnp.asarray(triangles.box, start[0].dtype)[root]
                size = jnp.linalg.norm(box[3:] - box[:3])
                mesh = triangles, root, _OWN * size / jnp.sqrt(dot(ray, ray))
            t = enter(kind, rows_of(to_unit.affine), to_unit.stretch, start, ray, mesh)
            return found | (shown & (t > 0) & (t < reach)), None

        found, _ = jax.lax.scan(meets, found, (_select(maps, ids), jnp.asarray(ids), visible[ids]))
    return found
