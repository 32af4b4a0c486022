"""The GPU kernel, run by Pallas's interpreter, against the reference renderer."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from test_raycast import random_scene

from milx.render import Renderer, kernel
from milx.render.kernel import bounding_radius
from milx.render.scene import to_uint8

# Not a multiple of the kernel's tile, and with lights of every type.
HEIGHT, WIDTH = 37, 50
LIGHTS = """<light type="point" pos="0.3 -0.5 1.5" diffuse=".5 .3 .2" specular=".4 .4 .4" attenuation="0.2 0.1 0.3"/>
    <light type="spot" pos="0 -1 2" dir="0 .5 -1" cutoff="30" exponent="4" diffuse=".3 .3 .6"/>
    <light type="directional" pos="0 0 3" dir=".2 .1 -1" diffuse=".3 .4 .1" ambient=".1 .1 .1"/></worldbody>"""


def render_both(seed, hidden=()):
    model = mujoco.MjModel.from_xml_string(random_scene(seed).replace("</worldbody>", LIGHTS))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = Renderer(model, "eye", HEIGHT, WIDTH)
    scene = renderer.scene(data)
    rgba = jnp.asarray(np.random.default_rng(seed).uniform(0.2, 1, scene.geom_rgba.shape))
    for geom in hidden:
        rgba = rgba.at[geom, 3].set(0)
    scene = dataclasses.replace(scene, geom_rgba=rgba)
    painted = jax.jit(lambda scene: renderer.paint(scene, interpret=True))(scene)
    frame = jax.jit(renderer.render)(scene)
    return np.asarray(painted).astype(int), np.asarray(to_uint8(frame.color)).astype(int), np.asarray(frame.geom_id)


@pytest.mark.parametrize(("seed", "word"), [(0, 32), (1, 32), (2, 32), (3, 3)])
def test_kernel_paints_what_the_reference_renders(monkeypatch, seed, word):
    """Compares images; words of three bits look at the scene's geoms in several parts."""
    monkeypatch.setattr(kernel, "_WORD", word)
    painted, expected, _ = render_both(seed)
    off = np.abs(painted - expected).max(axis=-1)
    # Rounding may turn a pixel over where two geoms meet.
    assert (off > 1).mean() < 2e-3
    assert np.std(expected) > 20


def test_kernel_knows_more_geoms_than_a_word_has_bits():
    """Paints 66 balls in a row, among them those of the last bits of two words, one pixel each."""
    balls = "".join(f'<geom size=".005" pos="{(i - 32.5) / 66} 0 0" rgba="{(i + 10) / 160} 1 1 1"/>' for i in range(66))
    camera = f'<camera name="eye" pos="0 0 1" fovy="{np.rad2deg(2 * np.arctan(1 / 132))}" xyaxes="1 0 0 0 1 0"/>'
    xml = f'<mujoco><worldbody><light pos="0 0 9"/>{camera}{balls}</worldbody></mujoco>'
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = Renderer(model, "eye", 1, 66)
    scene = renderer.scene(data)
    painted = np.asarray(jax.jit(lambda scene: renderer.paint(scene, interpret=True))(scene)).astype(int)
    frame = jax.jit(renderer.render)(scene)
    np.testing.assert_array_equal(frame.geom_id[0], np.arange(66))
    np.testing.assert_allclose(painted, np.asarray(to_uint8(frame.color)).astype(int), atol=1)
    assert painted[..., 0].min() > 30  # where no ball is seen it is black


def test_kernel_passes_over_geoms_without_alpha():
    painted, _, seen = render_both(0)
    hidden = np.bincount(seen[seen > 0]).argmax()
    without, also_without, _ = render_both(0, hidden=[hidden])
    assert (np.abs(without - also_without).max(axis=-1) > 1).mean() < 2e-3
    changed = np.abs(without - painted).max(axis=-1) > 1
    assert changed[seen == hidden].mean() > 0.9
    assert changed[seen != hidden].mean() < 2e-3


@pytest.mark.slow
def test_kernel_paints_in_float32_whatever_the_scene_is_in():
    single = render_both(1)[0]
    with jax.enable_x64(True):
        double = render_both(1)[0]
    assert (np.abs(double - single).max(axis=-1) > 1).mean() < 2e-3


def test_bounding_balls_touch_the_farthest_point_of_every_geom():
    size = np.random.default_rng(0).uniform(0.1, 1, (6, 3))
    geom = mujoco.mjtGeom
    kinds = [geom.mjGEOM_PLANE, geom.mjGEOM_SPHERE, geom.mjGEOM_CAPSULE]
    kinds += [geom.mjGEOM_ELLIPSOID, geom.mjGEOM_CYLINDER, geom.mjGEOM_BOX]
    found = bounding_radius(np.array([int(kind) for kind in kinds]), jnp.asarray(size))
    expected = [
        np.inf,
        size[1, 0],
        size[2, 0] + size[2, 1],
        size[3].max(),
        np.hypot(size[4, 0], size[4, 1]),
        np.sqrt((size[5] ** 2).sum()),
    ]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
