"""Fewer triangles for large meshes, which are drawn faster then.

Edges are collapsed where the surface moves least, by quadric error metrics (Garland & Heckbert, "Surface simplification
using quadric error metrics", SIGGRAPH 1997), by the library fast-simplification. Open borders stay as they are, since
holes would open where sheets of triangles meet; a mesh of many sheets keeps more triangles than it should. Normals and
texture coordinates of a new triangle are those of an old one, continued linearly: of the nearest that faces about as
the new one does, so that sharp edges stay sharp, and seams of textures stay seams.
"""

import numpy as np

_NEAREST = 16
"""Old triangles among which a new one chooses."""
_ALIKE = 0.7
"""The cosine of the angle between two triangles' normals from which on they face about alike."""
_SLIVER = 0.05
"""What lies beside a triangle cannot be told from it if its height is less than this fraction of its longest edge."""


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
    return np.concatenate([place, _continued(old, place)], axis=-1).astype(corners.dtype)


def _continued(old: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Continues what triangles [F, 3, C] have beside their positions to the corners of others, [F', 3, 3]."""
    from scipy.spatial import KDTree

    a, u, v = old[:, 0, :3], old[:, 1, :3] - old[:, 0, :3], old[:, 2, :3] - old[:, 0, :3]
    facing, area = _normal(old[..., :3])
    longest = np.linalg.norm(np.stack([u, v, u - v]), axis=-1).max(axis=0)
    usable = np.flatnonzero(area >= _SLIVER * longest**2)
    if not len(usable):
        usable = np.arange(len(old))
    near = KDTree(old[usable, :, :3].mean(axis=1)).query(place.mean(axis=1), min(_NEAREST, len(usable)))[1]
    near = usable[near.reshape(len(place), -1)]
    alike = np.abs((facing[near] * _normal(place)[0][:, None]).sum(axis=-1))
    # The nearest that faces about alike, or the one most alike.
    chosen = near[np.arange(len(place)), np.minimum(alike, _ALIKE).argmax(axis=1)]
    flat, s = facing[chosen][:, None], place - a[chosen][:, None]
    scale = np.maximum(area[chosen], 1e-30)[:, None]
    beta = np.cross(s, v[chosen][:, None]) @ np.swapaxes(flat, 1, 2)
    gamma = np.cross(u[chosen][:, None], s) @ np.swapaxes(flat, 1, 2)
    beta, gamma = beta / scale[..., None], gamma / scale[..., None]
    first, second, third = np.moveaxis(old[chosen, :, 3:], 1, 0)[:, :, None]
    return (1 - beta - gamma) * first + beta * second + gamma * third


def _normal(place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the unit normals [F, 3] of triangles [F, 3, 3], zero of those without an area, and twice their areas."""
    cross = np.cross(place[:, 1] - place[:, 0], place[:, 2] - place[:, 0])
    area = np.linalg.norm(cross, axis=1)
    return cross / np.maximum(area, 1e-30)[:, None], area
