"""What is seen where: against MuJoCo's own rays, and against the geometry of a pinhole camera."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from milx.render import Renderer

HEIGHT, WIDTH = 48, 60
CAMERA = '<camera name="eye" pos="0 -1.8 1.1" xyaxes="1 0 0 0 .5 .85" fovy="48"/>'
# One light per color channel, from the side of the camera: on white geoms the color then tells the normal.
TO_LIGHTS = np.array([[0.0, -1.0, 0.0], [0.6, 0.0, 0.8], [-0.6, 0.0, 0.8]])
SOLIDS = ("sphere", "capsule", "ellipsoid", "cylinder", "box")


def random_scene(seed: int) -> str:
    """Draws two of every solid in random poses above an infinite floor, and two finite planes that face the camera."""
    rng = np.random.default_rng(seed)
    bodies = ""
    for kind in 2 * SOLIDS:
        pos, quat = rng.uniform([-0.6, -0.5, 0.1], [0.6, 0.5, 0.7]), rng.normal(size=4)
        size = rng.uniform(0.03, 0.15, 3)
        bodies += (
            f'<body pos="{" ".join(map(str, pos))}" quat="{" ".join(map(str, quat))}"><freejoint/>'
            f'<geom type="{kind}" size="{" ".join(map(str, size))}" pos=".02 0 .01" euler="10 20 30"/></body>'
        )
    for side in (-1, 1):
        tilt = rng.uniform(30, 80)
        bodies += f'<body pos="{0.7 * side} .6 .4" euler="{tilt} 0 0"><geom type="plane" size=".3 .2 1"/></body>'
    lights = "".join(
        f'<light type="directional" dir="{-x} {-y} {-z}" diffuse="{r} {g} {b}" specular="0 0 0"/>'
        for (x, y, z), (r, g, b) in zip(TO_LIGHTS, np.eye(3), strict=True)
    )
    return f"""<mujoco><statistic extent="2"/><visual><headlight active="0"/></visual>
        <default><geom rgba="1 1 1 1"/></default><worldbody>{CAMERA}{lights}
        <geom type="plane" size="0 0 1"/>{bodies}<geom type="sphere" size="9" group="3"/></worldbody></mujoco>"""


def mujoco_rays(model, data, directions):
    """Casts MuJoCo's rays along directions [H, W, 3]: geom ids, distances (in their lengths) and normals."""
    geom_id, distance = np.full((HEIGHT, WIDTH), -1), np.full((HEIGHT, WIDTH), np.inf)
    normal = np.zeros((HEIGHT, WIDTH, 3))
    shown = np.array([1, 1, 1, 0, 0, 0], np.uint8)
    found, outwards = np.zeros(1, np.int32), np.zeros(3)
    for i, j in np.ndindex(HEIGHT, WIDTH):
        along = mujoco.mj_ray(model, data, data.cam_xpos[0], directions[i, j], shown, True, -1, found, outwards)
        if found[0] >= 0:
            geom_id[i, j], distance[i, j], normal[i, j] = found[0], along, outwards
    return geom_id, distance, normal


def test_agrees_with_mujoco_rays_on_random_scenes():
    models = [mujoco.MjModel.from_xml_string(random_scene(seed)) for seed in range(4)]
    datas = [mujoco.MjData(model) for model in models]
    for model, data in zip(models, datas, strict=True):
        mujoco.mj_forward(model, data)
    # Sizes and poses are part of the scene, so one compiled renderer serves all models of one structure.
    renderer = Renderer(models[0], "eye", HEIGHT, WIDTH)
    scenes = [Renderer(m, "eye", HEIGHT, WIDTH).scene(d) for m, d in zip(models, datas, strict=True)]
    frames = jax.jit(jax.vmap(renderer.render))(jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes))

    half = np.tan(np.deg2rad(48) / 2)
    y, x = np.meshgrid(
        half * (1 - (np.arange(HEIGHT) + 0.5) * 2 / HEIGHT),
        half * WIDTH / HEIGHT * ((np.arange(WIDTH) + 0.5) * 2 / WIDTH - 1),
        indexing="ij",
    )
    seen_types: set[int] = set()
    for k, (model, data) in enumerate(zip(models, datas, strict=True)):
        directions = np.stack([x, y, -np.ones_like(x)], axis=-1) @ data.cam_xmat[0].reshape(3, 3).T
        geom_id, depth, normal = mujoco_rays(model, data, directions)
        same = np.asarray(frames.geom_id[k]) == geom_id
        assert same.mean() >= 0.995, f"scene {k}: ids agree on {same.mean():.2%}"
        hit = same & (geom_id >= 0)
        # The direction has unit length along the optical axis, so MuJoCo's distance is the depth.
        np.testing.assert_allclose(np.asarray(frames.depth[k])[hit], depth[hit], rtol=2e-5)
        assert np.isinf(np.asarray(frames.depth[k])[same & (geom_id < 0)]).all()
        wrong = np.abs(np.asarray(frames.color[k]) - np.maximum(normal @ TO_LIGHTS.T, 0)).max(axis=-1) > 5e-3
        # A pixel on the edge of a box or a cylinder may show the neighboring face.
        assert wrong[hit].mean() <= 0.002, f"scene {k}: normals differ on {wrong[hit].mean():.2%}"
        seen_types |= {int(model.geom_type[i]) for i in np.unique(geom_id[hit])}
    assert len(seen_types) == 6, "the scenes must show every primitive, or the comparison is idle"


@pytest.fixture(scope="module")
def one_sphere():
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><statistic extent="2"/><worldbody>{CAMERA}
        <geom type="sphere" size=".3"/></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = Renderer(model, "eye", HEIGHT, WIDTH)
    return jax.jit(renderer.render), renderer.scene(data)


def test_sphere_on_the_axis_has_the_radius_of_its_tangent_cone(one_sphere):
    render, scene = one_sphere
    distance, radius = 2.0, 0.3
    frame = render(dataclasses.replace(scene, geom_xpos=(scene.cam_xpos - distance * scene.cam_xmat[:, 2])[None]))
    pixels = np.tan(np.arcsin(radius / distance)) / np.tan(np.deg2rad(48) / 2) * HEIGHT / 2
    covered = np.asarray(frame.geom_id) == 0
    # Pixel centers inside a circle: their number differs from its area by about the root of the circumference.
    np.testing.assert_allclose(covered.sum(), np.pi * pixels**2, atol=np.sqrt(2 * np.pi * pixels))
    np.testing.assert_allclose(np.argwhere(covered).mean(axis=0), [(HEIGHT - 1) / 2, (WIDTH - 1) / 2], atol=1e-6)
    np.testing.assert_allclose(np.asarray(frame.depth)[covered].min(), distance - radius, rtol=1e-3)


@pytest.mark.parametrize(("right", "up"), [(0.5, 0.0), (0.0, 0.4), (-0.6, -0.3)])
def test_a_point_appears_at_its_projection_neither_mirrored_nor_flipped(one_sphere, right, up):
    render, scene = one_sphere
    depth = 2.0
    position = scene.cam_xpos + scene.cam_xmat @ jnp.array([right, up, -depth])
    frame = render(dataclasses.replace(scene, geom_xpos=position[None], geom_size=jnp.full((1, 3), 0.06)))
    row, column = np.argwhere(np.asarray(frame.geom_id) == 0).mean(axis=0)
    focal = HEIGHT / 2 / np.tan(np.deg2rad(48) / 2)
    np.testing.assert_allclose(column, (WIDTH - 1) / 2 + focal * right / depth, atol=0.5)
    np.testing.assert_allclose(row, (HEIGHT - 1) / 2 - focal * up / depth, atol=0.5)


def test_a_camera_inside_a_geom_sees_out_of_it(one_sphere):
    render, scene = one_sphere
    assert (np.asarray(render(dataclasses.replace(scene, geom_xpos=scene.cam_xpos[None])).geom_id) == -1).all()


def test_a_geom_of_alpha_zero_is_not_seen(one_sphere):
    render, scene = one_sphere
    seen = render(scene)
    gone = render(dataclasses.replace(scene, geom_rgba=scene.geom_rgba.at[0, 3].set(0.0)))
    assert (np.asarray(seen.geom_id) == 0).any()
    assert (np.asarray(gone.geom_id) == -1).all()
