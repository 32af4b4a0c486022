"""Meshes with fewer triangles: balls stay round, cubes keep their edges, and images hardly change."""

import itertools
import sys

import jax
import mujoco
import numpy as np
import pytest

from milx.render import Renderer
from milx.render.decimate import decimate


def table(place, normal):
    """Returns the corners [F, 3, 8] of triangles; the texture coordinates are x and y."""
    return np.concatenate([place, normal, place[..., :2]], axis=-1)


def ball():
    """Returns 5,120 triangles of a ball of radius 1."""
    spec = '<mujoco><asset><mesh name="m" builtin="sphere" params="4"/></asset></mujoco>'
    model = mujoco.MjModel.from_xml_string(spec)
    place = model.mesh_vert[model.mesh_face].astype(float)
    return table(place, place)


def cube(cells=8):
    """Returns the sides of a cube from -1 to 1, each of cells x cells x 2 triangles."""
    place, normal, ticks = [], [], np.linspace(-1, 1, cells + 1)
    for axis, side in itertools.product(range(3), (-1.0, 1.0)):
        outwards = side * np.eye(3)[axis]
        for (a, b), (c, d) in itertools.product(itertools.pairwise(ticks), repeat=2):
            flat = np.array([[a, c], [b, c], [b, d], [a, d]])
            square = np.insert(flat, axis, side, axis=1)
            for corners in (square[[0, 1, 2]], square[[0, 2, 3]]):
                right = np.cross(corners[1] - corners[0], corners[2] - corners[0]) @ outwards > 0
                place.append(corners if right else corners[::-1])
                normal.append(np.tile(outwards, (3, 1)))
    return table(np.array(place), np.array(normal))


def volume(corners):
    a, b, c = np.moveaxis(corners[..., :3], 1, 0)
    return np.einsum("fi,fi->", a, np.cross(b, c)) / 6


def test_a_ball_stays_round():
    few = decimate(ball(), 500)
    assert 400 < len(few) <= 500
    place, normal = few[..., :3], few[..., 3:6]
    radius = np.linalg.norm(place, axis=-1)
    np.testing.assert_allclose(radius, 1.0, rtol=0, atol=0.02)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1.0, rtol=0, atol=1e-6)
    # The nearest old corner is less than an edge of 0.08 away, and faces within 45 degrees of the new triangle.
    assert (np.einsum("fci,fci->fc", place, normal) / radius).min() > np.cos(0.09)
    np.testing.assert_allclose(volume(few), 4 / 3 * np.pi, rtol=0.02)
    np.testing.assert_allclose(few[..., 6:], place[..., :2], rtol=0, atol=0.05)


def test_edges_that_are_rounded_off_with_slivers_do_not_turn_the_surface():
    """A drum of 200 sides, whose rims are three rings of thin triangles that turn from its side to its top."""
    count, rings = 200, [(1.0, 0.0)] + [(0.95 + 0.05 * np.cos(t), 0.95 + 0.05 * np.sin(t)) for t in (0, 0.5, 1.0, 1.57)]
    normals = [(1.0, 0.0)] + [(np.cos(t), np.sin(t)) for t in (0, 0.5, 1.0, 1.57)]
    rings, normals = [*rings, (0.0, 1.0)], [*normals, (0.0, 1.0)]
    table = []
    for i, j in itertools.product(range(count), range(len(rings) - 1)):
        square = []
        for k, m in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)):
            x, y = np.cos(2 * np.pi * k / count), np.sin(2 * np.pi * k / count)
            (radius, z), (out, up) = rings[m], normals[m]
            square.append([radius * x, radius * y, z, out * x, out * y, up, 0, 0])
        table += [[square[0], square[1], square[2]], [square[0], square[2], square[3]]]
    whole = np.array(table)
    flat = np.cross(whole[:, 1, :3] - whole[:, 0, :3], whole[:, 2, :3] - whole[:, 0, :3])
    few = decimate(whole[np.linalg.norm(flat, axis=1) > 1e-9], 700)
    assert len(few) < 900
    flat = np.cross(few[:, 1, :3] - few[:, 0, :3], few[:, 2, :3] - few[:, 0, :3])
    area = np.linalg.norm(flat, axis=1)
    cosine = np.einsum("fi,fci->fc", flat / np.maximum(area, 1e-30)[:, None], few[..., 3:6]).min(axis=1)
    assert area[cosine < 0.7].sum() < 0.01 * area.sum()


def test_seams_of_textures_stay_seams():
    """A tube whose coordinate s runs once around: no triangle squeezes the way back into itself."""
    count = 64
    angle = 2 * np.pi * np.arange(count + 1) / count
    edge = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    place, normal, around = [], [], []
    for i, (low, high) in itertools.product(range(count), itertools.pairwise(np.linspace(-1, 1, 9))):
        square = [(i, low), (i + 1, low), (i + 1, high), (i, high)]
        for corners in ((0, 1, 2), (0, 2, 3)):
            chosen = [square[c] for c in corners]
            place.append([[*edge[k], z] for k, z in chosen])
            normal.append([[*edge[k], 0] for k, _ in chosen])
            around.append([[k / count, z] for k, z in chosen])
    whole = np.concatenate([np.array(x, float) for x in (place, normal, around)], axis=-1)
    few = decimate(whole, 300)
    assert len(few) < len(whole) / 2
    turn = np.arctan2(few[..., 1], few[..., 0]) / (2 * np.pi)
    off = few[..., 6] - turn
    np.testing.assert_allclose(off - np.round(off), 0, atol=0.02)
    assert np.ptp(few[..., 6], axis=1).max() < 0.2
    np.testing.assert_allclose(few[..., 7], few[..., 2], atol=1e-6)


def test_sheets_back_to_back_keep_their_sides():
    """The top of a cube and, 1 cm below, another one of other triangles that faces down and has another texture."""
    top, bottom = (whole[whole[:, :, 2].min(axis=1) > 0.99] for whole in (cube(24), cube(19)))
    bottom = bottom[:, ::-1].copy()
    bottom[..., 2] -= 0.01
    bottom[..., 5:] = -1, 5, 5
    few = decimate(np.concatenate([top, bottom]), 400)
    assert len(few) < (len(top) + len(bottom)) / 2
    flat = np.cross(few[:, 1, :3] - few[:, 0, :3], few[:, 2, :3] - few[:, 0, :3])
    side = np.broadcast_to(np.sign(flat[:, None, 2]), few.shape[:2])
    np.testing.assert_allclose(few[..., 5], side, atol=1e-9)
    np.testing.assert_allclose(few[..., 6:], np.where(side[..., None] > 0, few[..., :2], 5), atol=1e-6)


def test_a_cube_keeps_its_edges():
    whole = cube()
    few = decimate(whole, 12)
    assert len(few) == 12 < len(whole)
    np.testing.assert_allclose(np.abs(few[..., :3]), 1.0, atol=1e-6)
    np.testing.assert_allclose([volume(few), volume(whole)], 8.0, rtol=1e-6)
    flat = np.cross(few[:, 1, :3] - few[:, 0, :3], few[:, 2, :3] - few[:, 0, :3])
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    np.testing.assert_allclose(few[..., 3:6], np.broadcast_to(flat[:, None], (12, 3, 3)), atol=1e-6)
    np.testing.assert_allclose(few[..., 6:], few[..., :2], atol=1e-6)


def test_small_meshes_are_left_alone():
    few = cube(1)
    assert decimate(few, 12) is few


def test_images_with_fewer_triangles_hardly_change():
    model = mujoco.MjModel.from_xml_string("""<mujoco><statistic extent="1"/><asset>
        <mesh name="ball" builtin="sphere" params="4" scale=".1 .1 .1"/></asset><worldbody>
        <light dir="0 -.6 -.8" pos="0 1 1"/><camera name="eye" pos="0 -.5 0" xyaxes="1 0 0 0 0 1" fovy="40"/>
        <geom type="mesh" mesh="ball"/></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderers = [Renderer(model, "eye", 40, 40, max_triangles=most) for most in (None, 500)]
    whole, few = (jax.jit(renderer.render)(renderer.scene(data)) for renderer in renderers)
    assert len(renderers[0]._meshes.triangle) > 5000 > 1500 > len(renderers[1]._meshes.triangle)
    assert (whole.geom_id == few.geom_id).mean() > 0.98
    both = np.asarray((whole.geom_id >= 0) & (few.geom_id >= 0))
    assert np.abs(whole.depth - few.depth)[both].max() < 0.02
    assert np.abs(whole.color - few.color)[both].mean() < 0.02


def test_what_cannot_be_is_refused(monkeypatch):
    model = mujoco.MjModel.from_xml_string('<mujoco><worldbody><camera/><geom size="1"/></worldbody></mujoco>')
    with pytest.raises(ValueError, match="max_triangles=3: expected at least 4, or None"):
        Renderer(model, 0, 8, 8, max_triangles=3)
    monkeypatch.setitem(sys.modules, "fast_simplification", None)
    message = "max_triangles: got 12, and a mesh has 768: install milx with the extra 'meshes'"
    with pytest.raises(ValueError, match=message):
        decimate(cube(), 12)
