"""MuJoCo's textures on meshes, against interpolation by SciPy at the places that the pixels show."""

import jax
import mujoco
import numpy as np
import pytest
import scipy.ndimage

from milx.render import Renderer, images
from milx.render.scene import to_uint8

HEIGHT, WIDTH, ROWS, COLUMNS = 30, 40, 5, 7
QUAD = """<mujoco><statistic extent="1"/><visual>
    <headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/></visual><worldbody>
    <camera name="eye" pos=".1 -.2 2" fovy="50"/></worldbody></mujoco>"""
COLOR = 0.5, 1.0, 0.25


def square(textures, geoms):
    """Compiles pyramids whose base, a square of side 2, lies on top and shows the texture from (0, 0) to (1.5, 2).

    Args:
        textures: texels [h, w, channels] by name.
        geoms: for each a texture's name and its position.
    """
    spec = mujoco.MjSpec.from_string(QUAD)
    for name, texels in textures.items():
        height, width, channels = texels.shape
        spec.add_texture(
            name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, height=height, width=width, nchannel=channels
        ).data = texels.tobytes()
        spec.add_material(name=name).textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, -0.5]], float)
    faces = [0, 1, 2, 0, 2, 3, 1, 0, 4, 2, 1, 4, 3, 2, 4, 0, 3, 4]
    mesh = {"uservert": corners.ravel().tolist(), "userface": faces}
    texcoord = (corners[:, :2] + 1) * (0.75, 1.0)
    spec.add_mesh(name="seen", usertexcoord=texcoord.ravel().tolist(), **mesh)
    spec.add_mesh(name="bare", **mesh)
    for name, kind, place in geoms:
        geom = mujoco.mjtGeom.mjGEOM_MESH
        spec.worldbody.add_geom(type=geom, meshname=kind, material=name, pos=place, rgba=[*COLOR, 1])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def drawn(model, data):
    renderer = Renderer(model, "eye", HEIGHT, WIDTH)
    with jax.enable_x64(True):
        frame = jax.jit(renderer.render)(renderer.scene(data))
    return np.asarray(frame.color), np.asarray(frame.geom_id)


def expected(texels, depth):
    """Interpolates where the pixels meet the plane of the square, at this depth; and tells which meet the square."""
    half = np.tan(np.deg2rad(50) / 2)
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    x = 0.1 + depth * half * WIDTH / HEIGHT * ((column + 0.5) * 2 / WIDTH - 1)
    y = -0.2 + depth * half * (1 - (row + 0.5) * 2 / HEIGHT)
    rows, columns = texels.shape[:2]
    place = (y + 1) * 1.0 * rows - 0.5, (x + 1) * 0.75 * columns - 0.5
    shown = [
        scipy.ndimage.map_coordinates(texels[..., min(i, texels.shape[2] - 1)] / 255, place, order=1, mode="grid-wrap")
        for i in range(3)
    ]
    return np.stack(shown, axis=-1) * COLOR, (np.abs(x) < 1) & (np.abs(y) < 1)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_square_shows_its_texture_where_scipy_does(channels):
    texels = np.random.default_rng(0).integers(0, 256, (ROWS, COLUMNS, channels), np.uint8)
    color, geom = drawn(*square({"noise": texels}, [("noise", "seen", [0, 0, 0])]))
    wanted, inside = expected(texels, 2.0)
    assert 0.3 < inside.mean() < 1
    np.testing.assert_array_equal(geom >= 0, inside)
    np.testing.assert_allclose(color[inside], wanted[inside], rtol=0, atol=1e-6)


def test_a_texture_multiplies_highlights_and_at_most_full_light():
    """Adds emission, and the headlight's highlight below the camera: where they exceed 1, they count as 1."""
    texels = np.random.default_rng(2).integers(0, 256, (ROWS, COLUMNS, 3), np.uint8)
    model, data = square({"noise": texels}, [("noise", "seen", [0, 0, 0])])
    model.mat_emission[:] = 0.5
    model.vis.headlight.ambient, model.vis.headlight.specular = (0.2,) * 3, (1.0,) * 3
    bare, _ = square({"noise": np.full((1, 1, 3), 255, np.uint8)}, [("noise", "seen", [0, 0, 0])])
    bare.mat_emission[:] = 0.5
    bare.vis.headlight.ambient, bare.vis.headlight.specular = (0.2,) * 3, (1.0,) * 3
    (color, _), (lit, _) = drawn(model, data), drawn(bare, data)
    plain, inside = expected(texels, 2.0)
    assert lit[inside].max() == pytest.approx(1) and lit[inside].min() < 0.8 * COLOR[2]
    np.testing.assert_allclose(color[inside], (lit * plain / COLOR)[inside], rtol=0, atol=1e-6)


def test_every_mesh_has_its_own_texture_and_bare_ones_keep_their_color():
    rng = np.random.default_rng(1)
    textures = {name: rng.integers(0, 256, (*size, 3), np.uint8) for name, size in (("one", (2, 3)), ("two", (6, 4)))}
    places = [("one", "seen", [0, 0, -0.1]), ("two", "seen", [2, 0, 0]), ("two", "bare", [-2, 0, 0])]
    model, data = square(textures, places)
    assert len(images.of_model(model, np.arange(3)).texel) == 2 * 3 + 6 * 4, "a texture is kept once"
    color, geom = drawn(model, data)
    assert set(np.unique(geom)) == {-1, 0, 1, 2}
    np.testing.assert_allclose(color[geom == 2], np.tile(COLOR, ((geom == 2).sum(), 1)), atol=1e-6)
    alone, inside = expected(textures["one"], 2.1)
    np.testing.assert_allclose(color[(geom == 0) & inside], alone[(geom == 0) & inside], atol=1e-6)
    assert color[geom == 1].std(axis=0).min() > 0.02


def test_the_kernel_refuses_textures():
    model, data = square({"noise": np.zeros((1, 1, 3), np.uint8)}, [("noise", "seen", [0, 0, 0])])
    renderer = Renderer(model, "eye", 16, 16)
    with pytest.raises(ValueError, match="got shadows, or meshes with textures, expected neither: use render"):
        renderer.paint(renderer.scene(data), interpret=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mesh", "shadows", "by_kernel"), [("bare", False, True), ("bare", True, False), ("seen", False, False)]
)
def test_a_gpu_draws_by_the_kernel_what_the_kernel_can_draw(monkeypatch, mesh, shadows, by_kernel):
    texels = np.random.default_rng(0).integers(0, 256, (ROWS, COLUMNS, 3), np.uint8)
    model, data = square({"noise": texels}, [("noise", mesh, [0, 0, 0])])
    renderer, paint, calls = Renderer(model, "eye", 16, 16, shadows=shadows), Renderer.paint, []
    scene = renderer.scene(data)
    expected = np.asarray(to_uint8(renderer.render(scene).color), int)
    monkeypatch.setattr(Renderer, "paint", lambda *given: calls.append(given) or paint(*given, interpret=True))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert np.abs(renderer.pixels(scene) - expected).max() <= 1
    assert len(calls) == by_kernel
    assert expected.std() > 20


def test_without_a_texture_nothing_is_kept():
    model, _ = square({"noise": np.zeros((1, 1, 3), np.uint8)}, [("noise", "bare", [0, 0, 0])])
    assert images.of_model(model, np.arange(1)) is None
