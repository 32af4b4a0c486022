"""Light: closed forms of the shading laws, shadows where geometry puts them, gradients against differences."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from milx.render import Renderer

SIZE = 40
RGB = np.array([0.6, 0.4, 0.2])


def build(lights: str, geoms: str = "", *, shadows: bool = False, specular: float = 0.0, shininess: float = 0.5):
    """Builds a floor at z = 0 seen from 2 m above, with no headlight; returns (jitted render, scene)."""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><statistic extent="2"/><visual><headlight active="0"/></visual>
        <asset><material name="m" specular="{specular}" shininess="{shininess}"/></asset><worldbody>
        <camera name="eye" pos="0 0 2" fovy="60"/>{lights}
        <geom type="plane" size="3 3 1" material="m" rgba="{RGB[0]} {RGB[1]} {RGB[2]} 1"/>{geoms}
        </worldbody></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = Renderer(model, "eye", SIZE, SIZE, shadows=shadows)
    return jax.jit(renderer.render), renderer.scene(data)


def floor_points() -> np.ndarray:
    """Returns [H, W, 3] (m), where the pixels' rays meet the floor."""
    half = 2 * np.tan(np.deg2rad(30))
    steps = half * ((np.arange(SIZE) + 0.5) * 2 / SIZE - 1)
    x, y = np.meshgrid(steps, -steps)
    return np.stack([x, y, np.zeros_like(x)], axis=-1)


@pytest.fixture(scope="module")
def sunlit():
    return build('<light type="directional" dir="0 0 -1" ambient=".05 .1 .15" diffuse=".9 .8 .7" specular="0 0 0"/>')


@pytest.mark.parametrize("degrees", [0, 35, 60, 100])
def test_diffuse_light_follows_lamberts_law(sunlit, degrees):
    render, scene = sunlit
    angle = np.deg2rad(degrees)
    direction = jnp.array([[np.sin(angle), 0.0, -np.cos(angle)]])
    color = np.asarray(render(dataclasses.replace(scene, light_xdir=3 * direction)).color)
    expected = RGB * (np.array([0.05, 0.1, 0.15]) + np.array([0.9, 0.8, 0.7]) * max(np.cos(angle), 0.0))
    np.testing.assert_allclose(color, np.broadcast_to(expected, color.shape), atol=1e-5)


@pytest.mark.parametrize(("light", "ambient"), [("", 0.3), ('<light active="false"/>', 0.3), ("<light/>", 0.0)])
def test_where_no_light_is_on_things_show_three_tenths_of_their_color(light, ambient):
    """As MuJoCo's renderer has it; a light that is on, but shines elsewhere, leaves them dark."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><visual><headlight active="0"/></visual><worldbody>{light}
        <geom type="sphere" size=".5" pos="0 0 1" rgba=".4 .8 .2 1"/>
        <camera name="eye" pos="0 0 3"/></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = Renderer(model, "eye", 9, 9)
    color = np.asarray(renderer.render(renderer.scene(data)).color)
    np.testing.assert_allclose(color[4, 4], ambient * np.array([0.4, 0.8, 0.2]), atol=1e-6)


def test_specular_light_follows_the_half_vector():
    light, peak, shininess = np.array([0.5, 0.3, 1.5]), np.array([0.9, 0.6, 0.3]), 0.2
    render, scene = build(
        f'<light type="point" pos="{light[0]} {light[1]} {light[2]}" diffuse="0 0 0" specular=".9 .6 .3"/>',
        specular=0.8,
        shininess=shininess,
    )
    points = floor_points()
    to_light, to_eye = light - points, np.array([0, 0, 2]) - points
    half = sum(v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (to_light, to_eye))
    cosine = half[..., 2] / np.linalg.norm(half, axis=-1)
    expected = 0.8 * peak * cosine[..., None] ** (128 * shininess)
    assert expected.max() > 0.7, "the highlight must lie within the image"
    np.testing.assert_allclose(np.asarray(render(scene).color), expected, atol=1e-4)


def test_spot_light_has_a_cone_and_weakens_with_distance():
    render, scene = build(
        '<light type="spot" pos="0 0 1.2" dir="0 0 -1" cutoff="30" exponent="4" attenuation=".5 .2 .1" '
        'diffuse=".8 .8 .8" specular="0 0 0"/>'
    )
    points = floor_points()
    distance = np.linalg.norm(np.array([0, 0, 1.2]) - points, axis=-1)
    cosine = 1.2 / distance
    strength = cosine**4 / (0.5 + 0.2 * distance + 0.1 * distance**2) * (cosine >= np.cos(np.deg2rad(30)))
    expected = RGB * (0.8 * strength * cosine)[..., None]
    np.testing.assert_allclose(np.asarray(render(scene).color), expected, atol=1e-5)


@pytest.mark.parametrize("kind", ["directional", "point"])
def test_the_shadow_of_a_sphere_lies_where_geometry_says(kind):
    center, radius, place = np.array([0.3, 0.2, 0.5]), 0.2, np.array([0.9, 0.5, 1.6])
    lights = f'<light type="{kind}" pos="{place[0]} {place[1]} {place[2]}" dir="{-place[0]} {-place[1]} {-place[2]}"/>'
    geoms = f'<geom type="sphere" size="{radius}" pos="{center[0]} {center[1]} {center[2]}"/>'
    render, scene = build(lights, geoms, shadows=True)
    frame = render(scene)
    points = floor_points()
    ray = np.broadcast_to(place, points.shape) if kind == "directional" else place - points
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    # A floor point is in shadow when the line to its light passes the center closer than the radius.
    off = center - points
    passes = np.linalg.norm(off - (off * ray).sum(-1, keepdims=True) * ray, axis=-1)
    floor = (np.asarray(frame.geom_id) == 0) & (np.abs(passes - radius) > 1e-4)
    dark = (np.asarray(frame.color) == 0).all(axis=-1)
    assert (dark & floor).sum() > 30
    np.testing.assert_array_equal(dark[floor], (passes < radius)[floor])


def test_shadows_leave_a_lit_convex_geom_alone():
    lights = '<light type="directional" dir="-.3 -.2 -1" castshadow="{}" ambient=".1 .1 .1"/>'
    geoms = '<geom type="box" size=".2 .3 .1" pos="0 0 .4" euler="20 30 40"/>'
    frames = []
    for casts in ("true", "false"):
        render, scene = build(lights.format(casts), geoms, shadows=True)
        frames.append(render(scene))
    box = np.asarray(frames[0].geom_id) == 1
    np.testing.assert_allclose(np.asarray(frames[0].color)[box], np.asarray(frames[1].color)[box], atol=1e-6)


@pytest.fixture(scope="module")
def lively():
    """Makes a function: mean color of a scene with solids, shadows, background and two kinds of light."""
    render, scene = build(
        '<light type="directional" dir="-.3 .2 -1" diffuse=".5 .5 .5"/>'
        '<light type="spot" pos=".4 .4 1.5" dir="-.2 -.2 -1" ambient=".1 .1 .1" castshadow="false"/>',
        '<geom type="sphere" size=".2" pos=".2 0 .3"/><geom type="cylinder" size=".1 .2" pos="-.3 .2 .2"/>'
        '<geom type="capsule" size=".1 .2" pos="-.3 -.3 .2" euler="60 0 0"/>',
        shadows=True,
        specular=0.3,
    )
    scene = dataclasses.replace(scene, geom_size=scene.geom_size.at[0, :2].set(0.8))
    assert (np.asarray(render(scene).geom_id) == -1).any()
    weights = np.random.default_rng(0).uniform(size=(SIZE, SIZE, 3)).astype(np.float32)
    return jax.jit(lambda s: jnp.mean(weights * render(s).color)), scene


@pytest.fixture(scope="module")
def gradient(lively):
    mean_color, scene = lively
    return jax.jit(jax.grad(mean_color))(scene)


# Colors enter linearly, so a long step costs nothing; poses enter smoothly where the shadow's edge is left alone.
@pytest.mark.parametrize(
    ("field", "rows", "step", "rtol"),
    [
        ("geom_rgba", slice(None), 5e-2, 2e-3),
        ("light_diffuse", slice(None), 5e-2, 2e-3),
        ("light_ambient", slice(None), 5e-2, 2e-3),
        ("light_specular", slice(None), 5e-2, 2e-3),
        ("light_xpos", slice(1, 2), 1e-2, 2e-2),
    ],
)
def test_gradient_agrees_with_differences(lively, gradient, field, rows, step, rtol):
    mean_color, scene = lively
    value = np.asarray(getattr(scene, field))
    direction = np.zeros_like(value)
    direction[rows] = np.random.default_rng(1).uniform(0.3, 1.0, value[rows].shape)
    if field == "geom_rgba":
        direction[:, 3] = 0.0
    above, below = (
        float(mean_color(dataclasses.replace(scene, **{field: value + s * direction}))) for s in (step, -step)
    )
    slope = float(np.sum(np.asarray(getattr(gradient, field)) * direction))
    assert abs(slope) > 1e-3
    np.testing.assert_allclose(slope, (above - below) / (2 * step), rtol=rtol)


def test_all_gradients_are_finite_and_geometry_has_none(gradient):
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    for field in ("geom_xpos", "geom_xmat", "geom_size", "cam_xpos", "cam_xmat"):
        assert not np.asarray(getattr(gradient, field)).any()
