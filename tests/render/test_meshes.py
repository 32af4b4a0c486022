"""Rays through triangle meshes, against MuJoCo's own rays and against all triangles one by one."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from milx.render import Renderer, meshes

HEIGHT, WIDTH = 40, 52
TO_LIGHTS = np.array([[0.0, -1.0, 0.0], [0.6, 0.0, 0.8], [-0.6, 0.0, 0.8]])
KINDS = {
    "torus": 'builtin="supertorus" params="48 0.3 1 1"',
    "rounded": 'builtin="supersphere" params="48 0.4 0.6"',
    "cone": 'builtin="cone" params="24 0.5"',
    "wedge": 'builtin="wedge" params="8 12 40 70 0.4"',
}


def robot(seed: int) -> str:
    """Draws an arm of four links on a table, of meshes of various sizes with a primitive between them."""
    rng, arm, end = np.random.default_rng(seed), "", ""
    for i, kind in enumerate(KINDS):
        x, y, z = rng.uniform(-40, 40, 3)
        arm += f'<body pos="0 0 .22" euler="{x} {y} {z}"><joint axis="{rng.normal()} 1 0"/>'
        arm += f'<geom type="mesh" mesh="{kind}{i % 2}"/><geom type="capsule" fromto="0 0 0 0 0 .2" size=".03"/>'
        end += "</body>"
    assets = "".join(
        f'<mesh name="{kind}{size}" {how} scale="{a} {b} {c}"/>'
        for kind, how in KINDS.items()
        for size, (a, b, c) in enumerate(rng.uniform(0.06, 0.14, (2, 3)))
    )
    lights = "".join(
        f'<light type="directional" dir="{-x} {-y} {-z}" diffuse="{r} {g} {b}" specular="0 0 0"/>'
        for (x, y, z), (r, g, b) in zip(TO_LIGHTS, np.eye(3), strict=True)
    )
    return f"""<mujoco><statistic extent="2"/><visual><headlight active="0"/></visual><asset>{assets}</asset>
        <default><geom rgba="1 1 1 1"/></default><worldbody>{lights}
        <camera name="eye" pos="0 -1.1 .9" xyaxes="1 0 0 0 .5 .85" fovy="46"/>
        <geom type="plane" size="0 0 1"/><body pos="0 0 .1">{arm}{end}</body></worldbody></mujoco>"""


def ready(text: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def mujoco_rays(model, data):
    """Casts MuJoCo's rays through all pixels: ids and depths [P], and normals [P, 3]."""
    half = np.tan(np.deg2rad(46) / 2)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    x = half * WIDTH / HEIGHT * ((columns + 0.5) * 2 / WIDTH - 1)
    ahead = np.stack([x, half * (1 - (rows + 0.5) * 2 / HEIGHT), -np.ones_like(x)], axis=-1)
    rays = (ahead @ data.cam_xmat[0].reshape(3, 3).T).reshape(-1, 3)
    geom, depth, normal = np.zeros(len(rays), np.int32), np.full(len(rays), np.inf), np.zeros((len(rays), 3))
    for i, ray in enumerate(rays):
        found, facing = np.zeros(1, np.int32), np.zeros(3)
        along = mujoco.mj_ray(model, data, data.cam_xpos[0], ray, None, True, -1, found, facing)
        geom[i], normal[i] = found[0], facing
        depth[i] = along if along >= 0 else np.inf
    return geom, depth, normal


@pytest.mark.parametrize("seed", [0, 1])
def test_a_robot_of_meshes_is_where_mujocos_rays_meet_it(seed):
    """Draws two poses of it at once."""
    model, data = ready(robot(seed))
    renderer, scenes, expected = Renderer(model, "eye", HEIGHT, WIDTH), [], []
    for angle in (0.0, 0.4):
        data.qpos[:] = angle
        mujoco.mj_forward(model, data)
        scenes.append(renderer.scene(data))
        expected.append(mujoco_rays(model, data))
    frames = jax.jit(jax.vmap(renderer.render))(jax.tree.map(lambda *x: jnp.stack(x), *scenes))
    for number, (geom, depth, normal) in enumerate(expected):
        frame = jax.device_get(jax.tree.map(lambda x, number=number: x[number], frames))
        same = frame.geom_id.ravel() == geom
        on_mesh = same & (model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH) & (geom >= 0)
        assert same.mean() >= 0.995
        assert on_mesh.mean() > 0.03 and len(np.unique(geom[on_mesh])) >= 3
        np.testing.assert_allclose(frame.depth.ravel()[on_mesh], depth[on_mesh], rtol=2e-5)
        lit = np.maximum(normal @ TO_LIGHTS.T, 0)
        wrong = np.abs(frame.color.reshape(-1, 3) - lit).max(axis=-1) > 5e-3
        assert wrong[on_mesh].mean() <= 0.01, "an edge of a triangle may show the neighboring one"


@pytest.mark.parametrize("fronts", [True, False])
def test_rays_find_the_nearest_of_all_triangles(fronts):
    """Casts rays from all sides into triangles in no order, and compares them with a loop in NumPy, in float64."""
    rng = np.random.default_rng(0)
    corners = rng.uniform(-1, 1, (201, 1, 3)) + rng.uniform(-0.5, 0.5, (201, 3, 3))
    nodes = meshes._Nodes()
    nodes.add(corners[:60])
    second = len(nodes.box)
    nodes.add(corners[60:])
    tables = nodes.arrays(np.array([0, second], np.int32))
    find = jax.jit(functools.partial(meshes.meet, tables, fronts=fronts))
    o = rng.normal(size=(300, 3))
    o *= 3 / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-1, 1, (300, 3)) - o
    for root, own in ((0, corners[:60]), (second, corners[60:])):
        with jax.enable_x64(True):
            distance, triangle = find(jnp.asarray(root), tuple(jnp.asarray(o.T)), tuple(jnp.asarray(d.T)))
        a, u, v = own[:, 0], own[:, 1] - own[:, 0], own[:, 2] - own[:, 0]
        matrix = np.stack(np.broadcast_arrays(u, v, -d[:, None]), axis=-1)  # o - a = β u + γ v - t d
        beta, gamma, t = np.moveaxis(np.linalg.solve(matrix, (o[:, None] - a)[..., None])[..., 0], -1, 0)
        side = (np.cross(u, v) @ d.T < 0).T | (not fronts)
        hit = (beta >= 0) & (gamma >= 0) & (beta + gamma <= 1) & (t >= 0) & side
        expected = np.where(hit, t, np.inf).min(axis=1)
        assert 0.3 < np.isfinite(expected).mean() < 1
        np.testing.assert_allclose(distance, expected, rtol=1e-9)
        meets = np.isfinite(expected)
        seen = tables.triangle[np.asarray(triangle)[meets], 0]
        nearest = own[np.where(hit, t, np.inf).argmin(axis=1)[meets], 0]
        np.testing.assert_allclose(seen, nearest, rtol=0, atol=1e-12)


def test_a_mesh_throws_its_shadow():
    """A square plate of two triangles, lit from above, darkens the floor below it."""
    model, data = ready("""<mujoco><statistic extent="2"/><visual><headlight active="0"/></visual>
        <asset><mesh name="plate" vertex="-.3 -.3 0  .3 -.3 0  .3 .3 0  -.3 .3 0  0 0 .01"
        face="0 2 1  0 3 2  0 1 4  1 2 4  2 3 4  3 0 4"/></asset><worldbody>
        <light type="directional" dir="0 0 -1" diffuse="1 1 1" specular="0 0 0" castshadow="true"/>
        <camera name="eye" pos="0 -1.5 .25" xyaxes="1 0 0 0 .2 1" fovy="50"/>
        <geom type="plane" size="0 0 1" rgba="1 1 1 1"/><geom type="mesh" mesh="plate" pos="0 0 .5" rgba="1 1 1 1"/>
        </worldbody></mujoco>""")
    renderer = Renderer(model, "eye", HEIGHT, WIDTH, shadows=True)
    scene = renderer.scene(data)
    frame = jax.jit(renderer.render)(scene)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    half = np.tan(np.deg2rad(25))
    ahead = np.stack(
        [
            half * WIDTH / HEIGHT * ((columns + 0.5) * 2 / WIDTH - 1),
            half * (1 - (rows + 0.5) * 2 / HEIGHT),
            -np.ones((HEIGHT, WIDTH)),
        ],
        axis=-1,
    )
    point = data.cam_xpos[0] + np.asarray(frame.depth)[..., None] * (ahead @ data.cam_xmat[0].reshape(3, 3).T)
    floor = np.asarray(frame.geom_id) == 0
    inside = floor & (np.abs(point[..., :2]).max(axis=-1) < 0.29)
    outside = floor & (np.abs(point[..., :2]).max(axis=-1) > 0.31)
    assert inside.sum() > 20 and outside.sum() > 100
    np.testing.assert_allclose(np.asarray(frame.color)[inside], 0.0, atol=1e-6)
    np.testing.assert_allclose(np.asarray(frame.color)[outside], 1.0, atol=1e-6)
    invisible = dataclasses.replace(scene, geom_rgba=scene.geom_rgba.at[1, 3].set(0.0))
    np.testing.assert_allclose(np.asarray(jax.jit(renderer.render)(invisible).color)[inside], 1.0, atol=1e-6)
