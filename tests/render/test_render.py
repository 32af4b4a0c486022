"""One call renders what a renderer of a changed model renders, batched, from several cameras, and with gradients."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

import milx
from milx.render import Renderer, render

XML = """<mujoco><asset><material name="paint" rgba=".9 .1 .2 1" specular="0"/></asset>
  <visual><headlight ambient=".3 .3 .3" diffuse=".2 .2 .2" specular="0 0 0"/></visual>
  <worldbody>
    <light name="lamp" pos="0 0 2" dir="0 .1 -1" diffuse=".4 .4 .4" specular="0 0 0"/>
    <camera name="front" pos="0 -1.5 1" xyaxes="1 0 0 0 .6 .8"/>
    <camera name="top" pos="0 0 2" fovy="30"/>
    <geom type="plane" size="1 1 1" rgba=".3 .4 .5 1"/>
    <body pos="0 0 .3"><freejoint/>
      <geom type="box" size=".2 .1 .1" material="paint"/>
      <geom type="sphere" size=".1" pos=".3 0 0" rgba=".2 .6 .3 1"/>
    </body>
  </worldbody></mujoco>"""
HEIGHT, WIDTH = 18, 24


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(XML)


@pytest.fixture(scope="module")
def data(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def change(model, seed):
    """Returns a model with other sizes, colors and lights, of which one geom has its material's color."""
    other, rng = mujoco.MjModel.from_xml_string(XML), np.random.default_rng(seed)
    other.geom_size[1:] *= rng.uniform(0.7, 1.3, other.geom_size[1:].shape)
    other.geom_rgba[[0, 2], :3] = rng.uniform(0.1, 0.9, (2, 3))
    other.mat_rgba[:, :3] = rng.uniform(0.1, 0.9, 3)
    other.light_pos[:, :2] += rng.uniform(-0.3, 0.3, 2)
    other.light_diffuse[:] = rng.uniform(0.2, 0.8, 3)
    return other


@pytest.mark.slow
def test_an_mjx_model_counts_as_a_model_with_its_values_does(model, data):
    others = [change(model, seed) for seed in (0, 1)]
    own = mjx.put_model(model)
    fields = ("geom_size", "geom_rgba", "mat_rgba", "light_pos", "light_diffuse")
    batch = {name: jnp.asarray(np.stack([getattr(m, name) for m in others]), jnp.float32) for name in fields}
    one = lambda values: render(model, data, "front", HEIGHT, WIDTH, mjx_model=own.replace(**values))  # noqa: E731
    found = jax.jit(jax.vmap(one))(batch)
    for i, other in enumerate(others):
        renderer = Renderer(other, "front", HEIGHT, WIDTH)
        expected = renderer.render(renderer.scene(data))
        assert (found.geom_id[i] == expected.geom_id).mean() > 0.995
        same = found.geom_id[i] == expected.geom_id
        np.testing.assert_allclose(found.color[i][same], expected.color[same], atol=2e-5)
        np.testing.assert_allclose(found.depth[i][same], expected.depth[same], rtol=1e-4)
    assert np.abs(found.color[0] - found.color[1]).max() > 0.1


@pytest.mark.slow
def test_several_cameras_see_what_each_sees(model, data):
    both = render(model, data, ["top", "front"], HEIGHT, WIDTH, shadows=True)
    for i, camera in enumerate(("top", "front")):
        renderer = Renderer(model, camera, HEIGHT, WIDTH, shadows=True)
        alone = renderer.render(renderer.scene(data))
        np.testing.assert_array_equal(both.geom_id[i], alone.geom_id)
        np.testing.assert_allclose(both.color[i], alone.color, atol=1e-6)
        np.testing.assert_allclose(both.depth[i], alone.depth, rtol=1e-6)
    # From above, the optical axis meets the top of the box.
    middle = both.depth[0, HEIGHT // 2, WIDTH // 2]
    np.testing.assert_allclose(middle, 2 - 0.4, atol=1e-5)


@pytest.mark.parametrize("name", ["geom_rgba", "mat_rgba", "light_diffuse"])
def test_the_gradient_of_colors_and_lights_is_that_of_differences(model, data, name):
    own = mjx.put_model(model)

    @jax.jit
    def brightness(values):
        return render(model, data, "front", HEIGHT, WIDTH, mjx_model=own.replace(**{name: values})).color.mean()

    values = getattr(own, name)
    gradient = jax.jit(jax.grad(brightness))(values)
    step = 0.02
    for index in np.ndindex(values.shape):
        if name == "geom_rgba" and (index[0] == 1 or index[1] == 3):
            continue  # it has its material's color; alpha is seen or not
        if name == "mat_rgba" and index[1] == 3:
            continue
        change = brightness(values.at[index].add(step)) - brightness(values.at[index].add(-step))
        np.testing.assert_allclose(gradient[index], change / (2 * step), atol=2e-5, err_msg=str(index))
    assert np.abs(gradient).max() > 0.005


@pytest.mark.slow
def test_rendering_needs_nothing_else_of_milx():
    code = f"""import sys, types
sys.modules["milx"] = types.ModuleType("milx")  # so that its own imports do not count
sys.modules["milx"].__path__ = {list(milx.__path__)}
import milx.render
print(*(name for name in sys.modules if name.startswith("milx.")))"""
    names = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    assert "milx.render.scene" in names
    assert {name.split(".")[1] for name in names} <= {"core", "render"}


def test_cameras_that_do_not_exist_are_refused(model, data):
    with pytest.raises(ValueError, match="camera: got none, expected at least one"):
        render(model, data, [], HEIGHT, WIDTH)
    with pytest.raises(ValueError, match="camera='side': expected one of"):
        render(model, data, ["front", "side"], HEIGHT, WIDTH)
