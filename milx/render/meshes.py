"""Triangle meshes: hierarchies of bounding boxes, built on the host, and the way of rays through them.

The triangles of a mesh are divided in two at the median of their centers, along the axis on which those spread most,
and so on until a leaf has LEAF of them or fewer. The nodes are numbered depth first: a node's first child follows it,
and `skip` is the node after its last descendant. A ray begins at the root of a mesh. If it enters a node's box before
the nearest triangle that it has found, it goes on with the next node, and otherwise with `skip`; it ends with the
root's `skip`. So there is no stack, and every ray has its own place in the hierarchy.

A ray o + t d meets a triangle a, a + u, a + v if

    β, γ >= 0    and    β + γ <= 1,    with    n = u x v,    det = -d · n,    s = o - a,
    t = s · n / det,    β = -d · (s x v) / det    and    γ = -d · (u x s) / det

(Möller & Trumbore, "Fast, minimum storage ray-triangle intersection", 1997). Meshes of robots have some triangles the
wrong way around, so both sides count, as for `mj_ray`. A camera inside a mesh sees its inside.

The surface faces in the direction (1 - β - γ) n_a + β n_b + γ n_c of MuJoCo's normals at the corners. Where these are
n, the triangle's edges are sharp, and elsewhere the mesh looks smooth. A corner whose normal lies nearly in the
triangle, as MuJoCo's do where two sheets lie back to back, has n instead.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from milx.render.decimate import decimate

Vector = tuple[jax.Array, ...]
LEAF = 2
"""Triangles of a leaf."""
_TINY = 1e-12
_IN_PLANE = 0.1
"""A corner's normal lies nearly in its triangle if the cosine of its angle to n is smaller."""


class Meshes(NamedTuple):
    """The hierarchies of all meshes of a model, one after the other; N nodes, F triangles, G geoms.

    Attributes:
        box: [N, 6] lowest and highest corner (m, in the geom's frame).
        skip: [N] int32, the node to go on with if the box is not entered.
        first: [N] int32, a leaf's first triangle; -1 if the node has children.
        triangle: [F, 3, 3], a, u and v (m). Leaves with fewer than LEAF triangles repeat their last one.
        normal: [F, 3, 3], unit normals n_a, n_b and n_c at the corners.
        texcoord: [F, 3, 2], texture coordinates (s, t) at the corners; zero for meshes that have none.
        root: [G] int32, the node where a geom's mesh begins; 0 for other geoms.
        radius: [G], how far a geom's mesh reaches from its origin (m); 0 for other geoms.
    """

    box: np.ndarray
    skip: np.ndarray
    first: np.ndarray
    triangle: np.ndarray
    normal: np.ndarray
    texcoord: np.ndarray
    root: np.ndarray
    radius: np.ndarray


def of_model(model: mujoco.MjModel, geoms: np.ndarray, most: int | None = None) -> Meshes:
    """Builds the hierarchies of the meshes of some geoms, each mesh once; those of more than `most` triangles of fewer.

    Raises:
        ValueError: as `decimate.decimate`.
    """
    root, radius, nodes = np.zeros(model.ngeom, np.int32), np.zeros(model.ngeom), _Nodes()
    of_mesh: dict[int, tuple[int, float]] = {}
    for geom in geoms:
        mesh = int(model.geom_dataid[geom])
        if mesh not in of_mesh:
            corners = _corners(model, mesh)
            corners = corners if most is None else decimate(corners, most)
            of_mesh[mesh] = len(nodes.box), float(np.linalg.norm(corners[..., :3], axis=-1).max())
            nodes.add(corners)
        root[geom], radius[geom] = of_mesh[mesh]
    return nodes.arrays(root, radius)


def _corners(model: mujoco.MjModel, mesh: int) -> np.ndarray:
    """Returns [F, 3, 8], the positions of the corners of a mesh's triangles, normals and texture coordinates there."""
    first, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    faces = slice(first, first + count)
    place = model.mesh_vert[model.mesh_vertadr[mesh] + model.mesh_face[faces]]
    normal = model.mesh_normal[model.mesh_normaladr[mesh] + model.mesh_facenormal[faces]]
    texcoord = np.zeros((count, 3, 2), place.dtype)
    if (begin := model.mesh_texcoordadr[mesh]) >= 0:
        texcoord = model.mesh_texcoord[begin + model.mesh_facetexcoord[faces]]
    return np.concatenate([place, normal, texcoord], axis=-1)


class _Nodes:
    """Nodes as they are made."""

    def __init__(self) -> None:
        self.box: list[np.ndarray] = []
        self.skip: list[int] = []
        self.first: list[int] = []
        self.corners: list[np.ndarray] = []

    def add(self, corners: np.ndarray) -> None:
        """Adds the nodes of triangles, of whose corners the table [F, 3, 8] begins with the positions."""
        node, place = len(self.box), corners[..., :3]
        self.box.append(np.concatenate([place.min(axis=(0, 1)), place.max(axis=(0, 1))]))
        self.skip.append(-1)
        if len(corners) <= LEAF:
            self.first.append(LEAF * len(self.corners))
            self.corners.append(np.concatenate([corners, np.repeat(corners[-1:], LEAF - len(corners), axis=0)]))
        else:
            self.first.append(-1)
            centers = place.mean(axis=1)
            half = len(corners) // 2
            order = np.argpartition(centers[:, np.ptp(centers, axis=0).argmax()], half)
            self.add(corners[order[:half]])
            self.add(corners[order[half:]])
        self.skip[node] = len(self.box)

    def arrays(self, root: np.ndarray, radius: np.ndarray) -> Meshes:
        """Makes arrays of all nodes."""
        corners = np.concatenate(self.corners).astype(float)
        (a, b, c), normal = np.moveaxis(corners[..., :3], 1, 0), corners[..., 3:6]
        flat = np.cross(b - a, c - a)
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
        along = np.abs(np.einsum("fi,fci->fc", flat, normal))[..., None] < _IN_PLANE
        normal = np.where(along, flat[:, None], normal)
        skip, first = np.array(self.skip, np.int32), np.array(self.first, np.int32)
        triangle = np.stack([a, b - a, c - a], axis=1)
        return Meshes(np.array(self.box), skip, first, triangle, normal, corners[..., 6:], root, radius)


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _dot(a: Vector, b: Vector) -> jax.Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _vectors(table: jax.Array) -> tuple[Vector, Vector, Vector]:
    """Splits [P, 3, D] into three vectors of D arrays [P]."""
    a, b, c = (tuple(table[:, i].T) for i in range(3))
    return a, b, c


def crosses(box: Vector, o: Vector, inverse: Vector) -> tuple[jax.Array, jax.Array]:
    """Computes where rays enter and leave a box; they miss it where they leave before they enter.

    Args:
        box: the three coordinates of the lowest corner, then those of the highest.
        o: where the rays start.
        inverse: 1 / d, as `inverse_of` has it.
    """
    ends = [((box[i] - o[i]) * inverse[i], (box[3 + i] - o[i]) * inverse[i]) for i in range(3)]
    enters = jnp.maximum(jnp.maximum(jnp.minimum(*ends[0]), jnp.minimum(*ends[1])), jnp.minimum(*ends[2]))
    leaves = jnp.minimum(jnp.minimum(jnp.maximum(*ends[0]), jnp.maximum(*ends[1])), jnp.maximum(*ends[2]))
    return enters, leaves


def inverse_of(d: Vector) -> Vector:
    """Computes 1 / d; a ray along a box's side meets it very far away."""
    return tuple(1 / jnp.where(jnp.abs(x) < _TINY, _TINY, x) for x in d)


def intersect(triangle: tuple[Vector, Vector, Vector], o: Vector, d: Vector) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Computes the distances to triangles a, u and v, infinite for rays that miss them, and β and γ."""
    a, u, v = triangle
    s, n = tuple(x - y for x, y in zip(o, a, strict=True)), _cross(u, v)
    det = -_dot(d, n)
    inverse = 1 / jnp.where(det != 0, det, 1.0)
    beta, gamma = -_dot(d, _cross(s, v)) * inverse, -_dot(d, _cross(u, s)) * inverse
    hit = (det != 0) & (beta >= 0) & (gamma >= 0) & (beta + gamma <= 1)
    return jnp.where(hit, _dot(s, n) * inverse, jnp.inf), beta, gamma


def facing(
    triangle: tuple[Vector, Vector, Vector], corners: tuple[Vector, Vector, Vector], o: Vector, d: Vector
) -> tuple[Vector, jax.Array, jax.Array]:
    """Interpolates the unit normal where rays meet triangles, on the side that they meet.

    Args:
        triangle: a, u and v.
        corners: n_a, n_b and n_c.
        o: where the rays start.
        d: their directions.

    Returns:
        The normals, of any finite length where a ray meets nothing; and β and γ, which are valid weights there, too.
    """
    _, beta, gamma = intersect(triangle, o, d)
    beta = jnp.clip(beta, 0.0, 1.0)
    gamma = jnp.clip(gamma, 0.0, 1 - beta)
    smooth = interpolate(corners, beta, gamma)
    flat = _cross(triangle[1], triangle[2])
    met = jnp.where(_dot(flat, d) > 0, -1.0, 1.0) * jnp.where(_dot(flat, smooth) < 0, -1.0, 1.0)
    inverse = met * jax.lax.rsqrt(jnp.maximum(_dot(smooth, smooth), _TINY))
    return tuple(inverse * x for x in smooth), beta, gamma


def interpolate(corners: tuple[Vector, Vector, Vector], beta: jax.Array, gamma: jax.Array) -> Vector:
    """Weighs what the three corners have."""
    return tuple((1 - beta - gamma) * a + beta * b + gamma * c for a, b, c in zip(*corners, strict=True))


def meet(
    meshes: Meshes, root: jax.Array, o: Vector, d: Vector, least: jax.Array | float
) -> tuple[jax.Array, jax.Array]:
    """Finds the nearest triangle that every ray meets from a distance on.

    Args:
        meshes: the hierarchies.
        root: int32, where to begin, of all rays or [P] of each; the number of nodes stands for no mesh.
        o: three [P] arrays, where the rays start, in the frame of the mesh (m).
        d: three [P] arrays, their directions.
        least: triangles that are met at a smaller distance (in lengths of d) are passed over.

    Returns:
        (distance [P] in lengths of d, infinite where nothing is met; triangle [P] int32, there the table's first).
    """
    every = jnp.broadcast_arrays(*o, *d)
    o, d = tuple(every[:3]), tuple(every[3:])
    dtype, count = o[0].dtype, len(meshes.skip)
    box, triangle = jnp.asarray(meshes.box, dtype), jnp.asarray(meshes.triangle, dtype)
    skip, first = jnp.asarray(meshes.skip), jnp.asarray(meshes.first)
    start = jnp.broadcast_to(jnp.asarray(root, jnp.int32), o[0].shape)
    end = jnp.where(start < count, skip[jnp.minimum(start, count - 1)], start)
    inverse = inverse_of(d)

    def visit(state: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        node, nearest, found = state
        at = jnp.minimum(node, count - 1)
        enters, leaves = crosses(tuple(box[at].T), o, inverse)
        inside = (enters <= leaves) & (leaves >= least) & (enters < nearest) & (node < end)
        leaf = first[at] >= 0
        for number in range(LEAF):
            index = jnp.maximum(first[at], 0) + number
            t, *_ = intersect(_vectors(triangle[index]), o, d)
            nearer = inside & leaf & (t >= least) & (t < nearest)
            nearest, found = jnp.where(nearer, t, nearest), jnp.where(nearer, index, found)
        after = jnp.where(inside & ~leaf, at + 1, skip[at])
        return jnp.where(node < end, after, node), nearest, found

    nothing = jnp.full(o[0].shape, jnp.inf, dtype), jnp.zeros(o[0].shape, jnp.int32)
    _, nearest, found = jax.lax.while_loop(lambda state: (state[0] < end).any(), visit, (start, *nothing))
    return nearest, found


def surface(meshes: Meshes, triangle: jax.Array, o: Vector, d: Vector) -> tuple[Vector, Vector]:
    """Computes what the surface is like where rays meet triangles.

    Args:
        meshes: the hierarchies.
        triangle: [P] int32, what `meet` has found.
        o: three [P] arrays, where the rays start, in the frame of the mesh (m).
        d: three [P] arrays, their directions.

    Returns:
        The unit normals, on the side that the rays meet, three [P] arrays in the frame of the mesh, of any finite
        length where a ray meets nothing; and the texture coordinates, two [P] arrays.
    """
    at = (jnp.asarray(x, d[0].dtype)[triangle] for x in (meshes.triangle, meshes.normal, meshes.texcoord))
    sides, normals, texcoords = map(_vectors, at)
    normal, beta, gamma = facing(sides, normals, o, d)
    return normal, interpolate(texcoords, beta, gamma)
