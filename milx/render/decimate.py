"""Fewer triangles for large meshes, which are drawn faster then.

Edges are collapsed where the surface moves least, by quadric error metrics (Garland & Heckbert, "Surface simplification
using quadric error metrics", SIGGRAPH 1997), by the library fast-simplification. Every new corner takes its normal and
its texture coordinates from the nearest old one that faces about as the new triangle does, so that sharp edges stay
sharp. Open borders stay as they are, since holes would open where sheets of triangles meet: a mesh of many sheets keeps
more triangles.
"""

import numpy as np

_NEAREST, _ALIKE = 8, 0.7
"""Old corners among which a new one chooses, as many as often meet in one place; and the cosine of the angle between
their normals and the triangle's from which on they face about as it does."""


def decimate(corners: np.ndarray, count: int) -> np.ndarray:
    """Replaces the triangles of a mesh by fewer.

    Args:
        corners: [F, 3, C], positions of the corners (m), their normals, and what else is to be kept of each.
        count: how many triangles there are to be; with as many as F, or more, nothing changes.

    Returns:
        [F', 3, C] with F' about `count`, or more where there are open borders.

    Raises:
        ImportError: without the library fast-simplification.
    """
    if count >= len(corners):
        return corners
    try:
        import fast_simplification
    except ImportError as error:
        raise ImportError("max_triangles needs fast-simplification: install milx with the extra 'meshes'") from error
    from scipy.spatial import KDTree

    old = corners.reshape(-1, corners.shape[-1]).astype(float)
    points, faces = np.unique(old[:, :3], axis=0, return_inverse=True)
    faces = faces.reshape(-1, 3).astype(np.int32)
    points, faces = fast_simplification.simplify(points, faces, target_count=count, preserve_border=True)
    place = points[faces]
    flat = np.cross(place[:, 1] - place[:, 0], place[:, 2] - place[:, 0])
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
    near = KDTree(old[:, :3]).query(place, min(_NEAREST, len(old)))[1]
    alike = np.abs((old[near, 3:6] * flat[:, None, None]).sum(axis=-1))
    first = np.minimum(alike, _ALIKE).argmax(axis=-1)  # the nearest that is enough alike, or the one most alike
    chosen = np.take_along_axis(near, first[..., None], axis=-1)[..., 0]
    return np.concatenate([place, old[chosen, 3:]], axis=-1).astype(corners.dtype)
