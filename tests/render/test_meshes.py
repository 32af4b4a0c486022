"""Rays through triangle meshes, against MuJoCo's own rays and against all triangles one by one."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from milx.render import Renderer, meshes
from milx.render.scene import to_uint8

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
    """Casts MuJoCo's rays through all pixels: ids and depths [P], normals of triangles and surfaces [P, 3]."""
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
    smooth, point = normal.copy(), data.cam_xpos[0] + np.where(np.isinf(depth), 0, depth)[:, None] * rays
    for number in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH):
        smooth[geom == number] = smooth_normals(model, data, number, point[geom == number], normal[geom == number])
    return geom, depth, normal, smooth


def smooth_normals(model, data, geom, point, normal):
    """Interpolates MuJoCo's normals at points [P, 3] of a mesh between the corners of the triangles they lie on."""
    mesh, turn = model.geom_dataid[geom], data.geom_xmat[geom].reshape(3, 3)
    faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
    a, b, c = np.moveaxis(model.mesh_vert[model.mesh_vertadr[mesh] + model.mesh_face[faces]], 1, 0).astype(float)
    flat = np.cross(b - a, c - a)
    has_area = np.linalg.norm(flat, axis=1) > 1e-12
    local = (point - data.geom_xpos[geom]) @ turn
    matrix = np.stack([b - a, c - a, flat], axis=-1)[has_area]  # p - a = β (b - a) + γ (c - a) + h n
    beta, gamma, off = np.moveaxis(np.linalg.solve(matrix, (local[:, None] - a[has_area])[..., None])[..., 0], -1, 0)
    outside = np.maximum(0, np.stack([-beta, -gamma, beta + gamma - 1])).max(axis=0)
    off = np.abs(off) * np.linalg.norm(flat[has_area], axis=1)
    nearest = np.where(outside < 1e-4, off, np.inf).argmin(axis=1)
    at = np.arange(len(local)), nearest
    weights = np.stack([1 - beta[at] - gamma[at], beta[at], gamma[at]])
    corners = model.mesh_normal[model.mesh_normaladr[mesh] + model.mesh_facenormal[faces]][has_area][nearest]
    found = np.einsum("kp,pki->pi", weights, corners) @ turn.T
    found *= np.where((found * normal).sum(axis=1) < 0, -1, 1)[:, None]
    return found / np.linalg.norm(found, axis=1, keepdims=True)


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
    for number, (geom, depth, flat, normal) in enumerate(expected):
        frame = jax.device_get(jax.tree.map(lambda x, number=number: x[number], frames))
        same = frame.geom_id.ravel() == geom
        on_mesh = same & (model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH) & (geom >= 0)
        assert same.mean() >= 0.995
        assert on_mesh.mean() > 0.03 and len(np.unique(geom[on_mesh])) >= 3
        np.testing.assert_allclose(frame.depth.ravel()[on_mesh], depth[on_mesh], rtol=2e-5)
        lit = np.maximum(normal @ TO_LIGHTS.T, 0)
        wrong = np.abs(frame.color.reshape(-1, 3) - lit).max(axis=-1) > 5e-3
        assert wrong[on_mesh].mean() <= 0.01  # the edge of a triangle may show the neighboring one
        assert (np.abs(normal - flat).max(axis=-1) > 0.05)[on_mesh].mean() > 0.2, "surfaces are smooth"


@pytest.mark.parametrize("least", [0.0, 0.9])
def test_rays_find_the_nearest_of_all_triangles(least):
    """Casts rays from all sides into triangles in no order, and compares them with a loop in NumPy, in float64."""
    rng = np.random.default_rng(0)
    corners = rng.uniform(-1, 1, (201, 1, 3)) + rng.uniform(-0.5, 0.5, (201, 3, 3))
    nodes = meshes._Nodes()
    normals = np.zeros_like(corners)
    nodes.add(np.concatenate([corners[:60], normals[:60]], axis=-1))
    second = len(nodes.box)
    nodes.add(np.concatenate([corners[60:], normals[60:]], axis=-1))
    tables = nodes.arrays(np.array([0, second], np.int32), np.ones(2))
    find = jax.jit(functools.partial(meshes.meet, tables, least=least))
    o = rng.normal(size=(300, 3))
    o *= 3 / np.linalg.norm(o, axis=1, keepdims=True)
    d = rng.uniform(-1, 1, (300, 3)) - o
    for root, own in ((0, corners[:60]), (second, corners[60:])):
        with jax.enable_x64(True):
            distance, triangle = find(jnp.asarray(root), tuple(jnp.asarray(o.T)), tuple(jnp.asarray(d.T)))
        a, u, v = own[:, 0], own[:, 1] - own[:, 0], own[:, 2] - own[:, 0]
        matrix = np.stack(np.broadcast_arrays(u, v, -d[:, None]), axis=-1)  # o - a = β u + γ v - t d
        beta, gamma, t = np.moveaxis(np.linalg.solve(matrix, (o[:, None] - a)[..., None])[..., 0], -1, 0)
        hit = (beta >= 0) & (gamma >= 0) & (beta + gamma <= 1) & (t >= least)
        expected = np.where(hit, t, np.inf).min(axis=1)
        assert 0.3 < np.isfinite(expected).mean() < 1
        np.testing.assert_allclose(distance, expected, rtol=1e-9)
        meets = np.isfinite(expected)
        seen = tables.triangle[np.asarray(triangle)[meets], 0]
        nearest = own[np.where(hit, t, np.inf).argmin(axis=1)[meets], 0]
        np.testing.assert_allclose(seen, nearest, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("at", "expected"),
    [
        ([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8], [-0.6, 0.0, 0.8]], [0.5 * 0.6 - 0.2 * 0.6, 0.3 * 0.6, 0.8]),
        ([[0.0, 0.0, 1.0]] * 3, [0.0, 0.0, 1.0]),
        ([[1.0, 0.0, 0.0], [0.0, 1.0, 0.05], [0.0, 0.0, 0.0]], [0.0, 0.0, 1.0]),
    ],
    ids=["smooth", "sharp", "in the plane"],
)
@pytest.mark.parametrize("turned", [1.0, -1.0])
@pytest.mark.parametrize("height", [2.0, -2.0])
def test_normals_are_interpolated_on_the_side_that_a_ray_meets(at, expected, turned, height):
    """Works out a triangle in the plane z = 0 by hand, at (0.3, 0.2), where the corners weigh 0.5, 0.3 and 0.2."""
    corners, nodes = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), meshes._Nodes()
    texcoord = [[0.0, 0.0], [2.0, 0.0], [1.0, 3.0]]
    nodes.add(np.concatenate([corners, turned * np.array(at), texcoord], axis=-1)[None])
    tables = nodes.arrays(np.zeros(1, np.int32), np.ones(1))
    surface = lambda o, d: meshes.surface(tables, jnp.zeros(1, jnp.int32), o, d)  # noqa: E731
    rays = [tuple(jnp.full(1, x) for x in ray) for ray in ((0.3, 0.2, height), (0.0, 0.0, -height))]
    found, place = (np.ravel(x) for x in surface(*rays))
    np.testing.assert_allclose(place, [0.3 * 2 + 0.2 * 1, 0.2 * 3], atol=1e-6)
    np.testing.assert_allclose(found, np.sign(height) * np.array(expected) / np.linalg.norm(expected), atol=1e-6)
    missed, _ = surface(rays[0], tuple(jnp.full(1, x) for x in (1.0, 0.0, 0.0)))
    assert np.isfinite(missed).all(), "a ray that misses"


def ball(radius: float, reverse: bool, where: str) -> str:
    """Returns the asset of a sphere of 5,120 triangles, with all of them turned around if `reverse`."""
    spec = '<mujoco><asset><mesh name="m" builtin="sphere" params="4"/></asset></mujoco>'
    model = mujoco.MjModel.from_xml_string(spec)
    faces = model.mesh_face[:, ::-1] if reverse else model.mesh_face
    numbers = lambda x: " ".join(map(str, np.ravel(x)))  # noqa: E731
    return f"""<mujoco><statistic extent="1"/><visual><headlight active="0"/><map znear="1e-4"/></visual><asset>
        <mesh name="ball" inertia="shell" vertex="{numbers(radius * model.mesh_vert)}" face="{numbers(faces)}"/></asset>
        <worldbody><light type="directional" dir="0 -.6 -.8" diffuse="1 1 1" specular="0 0 0" castshadow="true"/>
        <camera name="eye" pos="0 {-5 * radius} 0" xyaxes="1 0 0 0 0 1" fovy="40"/>
        <geom type="mesh" mesh="ball" rgba="1 1 1 1"/>{where}</worldbody></mujoco>"""


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("radius", [0.3, 0.01])
def test_a_ball_of_triangles_is_lit_as_a_ball_and_shades_only_what_lies_behind_it(radius, reverse):
    """A convex body shades nothing of its own lit side; the triangles of the small one have less than 1e-6 m^2."""
    floor = f'<geom type="plane" size="0 0 1" pos="0 0 {-radius}" rgba="1 1 1 1"/>'
    model, data = ready(ball(radius, reverse, floor))
    renderer = Renderer(model, "eye", HEIGHT, WIDTH, shadows=True)
    frame = jax.device_get(jax.jit(renderer.render)(renderer.scene(data)))
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    half = np.tan(np.deg2rad(20))
    x, z = half * WIDTH / HEIGHT * ((columns + 0.5) * 2 / WIDTH - 1), half * (1 - (rows + 0.5) * 2 / HEIGHT)
    point = np.array([0, -5 * radius, 0]) + frame.depth[..., None] * np.stack([x, np.ones_like(x), z], axis=-1)
    to_light, seen = np.array([0.0, 0.6, 0.8]), frame.geom_id == 0
    assert seen.mean() > 0.1
    np.testing.assert_allclose(np.linalg.norm(point[seen], axis=-1), radius, rtol=0.02)
    lit = np.maximum(point[seen] @ to_light / radius, 0)
    np.testing.assert_allclose(frame.color[seen][:, 0], lit, atol=0.004)
    ground = frame.geom_id == 1
    aside = np.linalg.norm(np.cross(point[ground], to_light), axis=-1) / radius  # from the ray through the middle
    np.testing.assert_allclose(frame.color[ground][aside < 0.97][:, 0], 0.0, atol=1e-6)
    np.testing.assert_allclose(frame.color[ground][aside > 1.03][:, 0], 0.8, atol=1e-6)
    assert (aside < 0.97).sum() > 10 and (aside > 1.03).sum() > 100


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_the_kernel_paints_meshes_as_the_reference_renders_them(seed):
    """Beside primitives that hide them and are hidden; the image is no multiple of the kernel's tile."""
    model, data = ready(robot(seed))
    renderer = Renderer(model, "eye", HEIGHT, WIDTH)
    scene = renderer.scene(data)
    painted = np.asarray(jax.jit(lambda scene: renderer.paint(scene, interpret=True))(scene)).astype(int)
    frame = jax.jit(renderer.render)(scene)
    meshes_seen = np.isin(frame.geom_id, np.flatnonzero(model.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH)))
    assert meshes_seen.mean() > 0.05
    off = np.abs(painted - np.asarray(to_uint8(frame.color)).astype(int)).max(axis=-1)
    # Rounding may turn a pixel over where two triangles meet.
    assert (off > 1).mean() < 2e-3
    assert (off[meshes_seen] > 1).mean() < 1e-2


def test_the_kernel_is_a_triton_program_with_meshes_too():
    """Lowers it for a GPU, which needs none: what Triton does not know fails here."""
    model, data = ready(robot(0))
    renderer = Renderer(model, "eye", HEIGHT, WIDTH)
    lowered = jax.jit(renderer.paint).trace(renderer.scene(data)).lower(lowering_platforms=("cuda",))
    assert lowered.as_text().count("__gpu$xla.gpu.triton") == 1
