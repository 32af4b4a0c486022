"""From a state to a scene to frames: parity with MuJoCo's poses and materials, batching, errors."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from milx.render import Renderer, to_uint8

XML = """<mujoco><asset><material name="shiny" rgba=".9 .1 .2 1" specular=".8" shininess=".9" emission=".1"/></asset>
  <worldbody>
    <light name="lamp" pos="0 0 2" dir="0 .1 -1"/>
    <camera name="fixed" pos="0 -1.5 1" xyaxes="1 0 0 0 .6 .8"/>
    <geom type="plane" size="1 1 1"/>
    <body pos="0 0 .3"><joint type="hinge" axis="0 .2 1"/>
      <geom type="capsule" size=".08 .2" euler="0 70 0" material="shiny"/>
      <geom type="sphere" size=".1" pos=".3 0 0" material="shiny" rgba="0 .5 .5 1"/>
      <body pos=".3 0 .1"><joint type="hinge" axis="0 1 0"/>
        <camera name="wrist" pos="0 0 .4" euler="10 20 0"/>
        <light name="torch" type="directional" pos="0 0 .1" dir=".3 0 -1"/>
        <geom type="box" size=".05 .05 .1"/>
      </body>
    </body>
  </worldbody></mujoco>"""


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(XML)


@pytest.fixture(scope="module")
def data(model):
    data = mujoco.MjData(model)
    data.qpos[:] = [0.7, -0.4]
    mujoco.mj_forward(model, data)
    return data


def test_mjx_poses_of_cameras_and_lights_on_bodies_are_mujocos(model, data):
    model_x = mjx.put_model(model)

    @jax.jit
    def place(qpos):
        state = mjx.make_data(model).replace(qpos=qpos)
        return renderer.scene(mjx.camlight(model_x, mjx.com_pos(model_x, mjx.kinematics(model_x, state))))

    renderer = Renderer(model, "wrist", 8, 8)
    scene = place(jnp.asarray(data.qpos, jnp.float32))
    for field, expected in {
        "cam_xpos": data.cam("wrist").xpos,
        "cam_xmat": data.cam("wrist").xmat.reshape(3, 3),
        "light_xpos": data.light_xpos,
        "light_xdir": data.light_xdir,
        "geom_xpos": data.geom_xpos,
        "geom_xmat": data.geom_xmat.reshape(-1, 3, 3),
    }.items():
        np.testing.assert_allclose(np.asarray(getattr(scene, field)), expected, atol=1e-6, err_msg=field)


def test_colors_and_materials_are_those_that_mujoco_draws(model, data):
    drawn = mujoco.MjvScene(model, maxgeom=20)
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL, drawn)
    geoms = {g.objid: g for g in drawn.geoms[: drawn.ngeom] if g.objtype == mujoco.mjtObj.mjOBJ_GEOM}
    renderer = Renderer(model, "fixed", 8, 8)
    scene = renderer.scene(data)
    assert len(geoms) == model.ngeom
    for i, geom in geoms.items():
        np.testing.assert_allclose(np.asarray(scene.geom_rgba[i]), geom.rgba, atol=1e-6)
        expected = [geom.emission, geom.specular, geom.shininess]
        np.testing.assert_allclose(renderer._materials[i], expected, atol=1e-6)


@pytest.mark.slow
def test_vmap_equals_a_loop(model, data):
    renderer = Renderer(model, "fixed", 24, 30, shadows=True)
    scene = renderer.scene(data)
    rng = np.random.default_rng(0)
    scenes = [
        dataclasses.replace(
            scene,
            geom_xpos=scene.geom_xpos + rng.normal(0, 0.02, (model.ngeom, 3)).astype(np.float32),
            geom_rgba=jnp.asarray(rng.uniform(0.1, 1, (model.ngeom, 4)), jnp.float32),
        )
        for _ in range(3)
    ]
    render = jax.jit(renderer.render)
    batched = jax.jit(jax.vmap(renderer.render))(jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes))
    for k, one in enumerate(scenes):
        frame = render(one)
        same = np.asarray(frame.geom_id) == np.asarray(batched.geom_id[k])
        # The two compile to different instructions; a pixel on a silhouette may fall either way.
        assert same.mean() >= 0.998
        np.testing.assert_allclose(np.asarray(frame.depth)[same], np.asarray(batched.depth[k])[same], rtol=1e-5)
        differs = np.abs(np.asarray(frame.color) - np.asarray(batched.color[k])).max(axis=-1) > 1e-3
        assert differs.mean() <= 0.002


def test_to_uint8_rounds_and_clips():
    np.testing.assert_array_equal(
        to_uint8(jnp.array([-1.0, 0.0, 0.4999 / 255, 0.5001 / 255, 1.0, 7.0])), [0, 0, 0, 1, 255, 255]
    )


@pytest.mark.parametrize("camera", ["nowhere", 2, -1])
def test_an_unknown_camera_is_named_in_the_error(model, camera):
    with pytest.raises(ValueError, match=rf"camera={camera!r}: expected one of \['fixed', 'wrist'\]"):
        Renderer(model, camera, 8, 8)


def test_an_empty_image_is_refused(model):
    with pytest.raises(ValueError, match="width=0: expected at least 1 pixel"):
        Renderer(model, "fixed", 8, 0)


TETRAHEDRON = '<asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>'


def with_mesh(group: int) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"""<mujoco>{TETRAHEDRON}<worldbody><camera pos="0 0 3"/>
        <geom size=".1"/><geom name="odd" type="mesh" mesh="m" group="{group}"/></worldbody></mujoco>""")


@pytest.mark.slow
@pytest.mark.parametrize(("group", "seen"), [(0, {-1, 1}), (3, {-1, 0})])
def test_a_mesh_is_seen_unless_it_is_in_a_hidden_group(group, seen):
    model = with_mesh(group)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = Renderer(model, 0, 9, 9)
    frame = renderer.render(renderer.scene(data))
    assert set(np.unique(frame.geom_id)) == seen


def test_a_height_field_is_refused():
    model = mujoco.MjModel.from_xml_string("""<mujoco>
        <asset><hfield name="h" nrow="3" ncol="3" size="1 1 1 .1"/></asset><worldbody><camera pos="0 0 3"/>
        <geom name="odd" type="hfield" hfield="h"/></worldbody></mujoco>""")
    with pytest.raises(ValueError, match="geom_type=mjGEOM_HFIELD of geom 0 'odd': expected a plane, sphere"):
        Renderer(model, 0, 8, 8)


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ('camera pos="0 0 1" projection="orthographic"', "cam_projection=1 of camera 0: expected perspective"),
        ('camera pos="0 0 1" sensorsize="1 1" focal="1 1" resolution="8 8"', "cam_sensorsize=.* expected none"),
        ('light type="image" texture="t"', "light_type=mjLIGHT_IMAGE of light 0"),
        ('light mode="track"', "light_mode=mjCAMLIGHT_TRACK of light 0: expected mjCAMLIGHT_FIXED"),
    ],
)
def test_what_cannot_be_shown_is_refused(attributes, message):
    texture = '<asset><texture name="t" type="cube" builtin="flat" width="4" height="4"/></asset>'
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>{texture}<worldbody><{attributes}/><camera pos="0 0 1"/>
        <geom size=".1"/></worldbody></mujoco>""")
    with pytest.raises(ValueError, match=message):
        Renderer(model, 0, 8, 8)
