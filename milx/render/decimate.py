"""Fewer triangles for large meshes, which are drawn faster then.

Edges are collapsed where the surface moves least, by quadric error metrics (Garland & Heckbert, "Surface simplification
using quadric error metrics", SIGGRAPH 1997), by the library fast-simplification. Open borders stay as they are, since
holes would open where sheets of triangles meet; a mesh of many sheets keeps more triangles than it should.

Every new corner has the normal of the nearest old one that faces about as the new triangle does, so that sharp edges
stay sharp, and sheets back to back keep their sides. What else there is, such as texture coordinates, is that of the
nearest old triangle that faces so, continued linearly to all three corners, so that seams of textures stay seams.
"""

import numpy as np

_NEAREST = 32
"""Old corners, or triangles, among which a new one chooses; fewer often meet in one place."""
_ALIKE = 0.7
"""The cosine of the angle between two normals from which on they face about alike."""
_SLIVER = 0.05
"""A triangle is not continued if its height is less than this fraction of its longest edge."""


def decimate(corners: np.ndarray, count: int) -> np.ndarray:
    """Replaces the triangles of a mesh by fewer.

    Args:
        corners: [F, 3, C], positions of the corners (m), their normals, and what else is to be kept of each.
        count: how many triangles there are to be; with as many as F, or more, nothing changes.

    Returns:
        [F', 3, C] with F' about `count`, or more where there are open borders.

    Raises:
        ValueError: if there are more than `count`, without the library fast-simplification.
    """
    if count >= len(corners):
        return corners
    try:
        import fast_simplification
    except ImportError as error:
        raise ValueError(
            f"max_triangles: got {count}, and a mesh has {len(corners)}: install milx with the extra 'meshes'"
        ) from error

    old = corners.astype(float)
    points, faces = np.unique(old[..., :3].reshape(-1, 3), axis=0, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    points, faces = fast_simplification.simplify(points, faces, target_count=count, preserve_border=True)
    place = points[faces]
    flat, _ = _normal(place)
    near = _nearest(old[..., :3].reshape(-1, 3), old[..., 3:6].reshape(-1, 3), place, flat[:, None])
    normal = old[..., 3:6].reshape(-1, 3)[near]
    return np.concatenate([place, normal, _continued(old, place, flat)], axis=-1).astype(corners.dtype)


def _nearest(old: np.ndarray, facing: np.ndarray, place: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Finds for places [..., 3] the nearest of N old ones, [N, 3], that faces about as wanted, or most nearly so."""
    from scipy.spatial import KDTree

    near = KDTree(old).query(place, min(_NEAREST, len(old)))[1].reshape(*place.shape[:-1], -1)
    alike = (facing[near] * wanted[..., None, :]).sum(axis=-1)
    first = np.minimum(alike, _ALIKE).argmax(axis=-1)
    return np.take_along_axis(near, first[..., None], axis=-1)[..., 0]


def _continued(old: np.ndarray, place: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """Continues what old triangles [F, 3, C] have beside normals to corners [F', 3, 3] of those that face `flat`."""
    facing, area = _normal(old[..., :3])
    chosen = _nearest(old[..., :3].mean(axis=1), facing, place.mean(axis=1), flat)
    a, b, c = (old[chosen, i, None] for i in range(3))
    u, v, s = b[..., :3] - a[..., :3], c[..., :3] - a[..., :3], place - a[..., :3]
    scaled = (facing[chosen] / np.maximum(area[chosen], 1e-30)[:, None])[:, None]
    beta = (np.cross(s, v) * scaled).sum(axis=-1, keepdims=True)
    gamma = (np.cross(u, s) * scaled).sum(axis=-1, keepdims=True)
    longest = np.linalg.norm(np.stack([u, v, u - v]), axis=-1).max(axis=0)[..., None]
    sliver = area[chosen][:, None, None] < _SLIVER * longest**2
    beta = np.where(sliver, np.clip(beta, 0, 1), beta)
    gamma = np.where(sliver, np.clip(gamma, 0, 1 - beta), gamma)
    a, b, c = a[..., 6:], b[..., 6:], c[..., 6:]
    return (1 - beta - gamma) * a + beta * b + gamma * c


def _normal(place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the unit normals [F, 3] of triangles [F, 3, 3], zero of those without an area, and twice their areas."""
    cross = np.cross(place[:, 1] - place[:, 0], place[:, 2] - place[:, 0])
    area = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(area, 1e-30)[:, None], area
