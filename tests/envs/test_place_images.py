"""What policies see and are told of place."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from milx.envs.base import State
from milx.envs.place import env as place
from milx.envs.place.env import NUM_CONTAINERS, NUM_JOINTS, Place
from milx.render.scene import Renderer, to_uint8


@pytest.fixture(scope="module")
def env():
    return Place((45, 50))


@pytest.fixture(scope="module")
def task(env):
    return env.sample_task(jax.random.key(0), "train")


@pytest.mark.slow
def test_the_image_is_that_of_the_tasks_own_model(env, task):
    """Compares geoms, sizes and colors with C MuJoCo's poses; what is not used is not seen."""
    task = dataclasses.replace(task, texture=task.texture._replace(family=jnp.zeros(4, jnp.int32)))
    state = env.reset(jax.random.key(5), task)
    model, ours = copy.copy(env.mj_model), env.model_of(task)
    for name in ("geom_pos", "geom_quat", "geom_size"):
        getattr(model, name)[:] = getattr(ours, name)
    model.geom_sameframe[:] = 0
    model.geom_rgba[:] = jax.jit(env.colors)(task)
    data = mujoco.MjData(model)
    data.qpos[:], data.mocap_pos[:] = state.qpos, state.mocap_pos
    mujoco.mj_forward(model, data)
    renderer = Renderer(model, env.camera, *env.image_shape)
    frame = jax.jit(renderer.render)(renderer.scene(data))
    # Rounding moves a silhouette by a hair: a pixel in a thousand may show its neighbor.
    off = np.abs(env.render(task, state).astype(int) - to_uint8(frame.color).astype(int)).max(axis=-1)
    assert (off > 1).mean() < 2e-3
    visible = set(np.unique(frame.geom_id))
    for i, geoms in enumerate(env._geom):
        used = np.asarray(env.colors(task)[geoms, 3]) > 0
        assert visible & set(geoms[used]), f"thing {i} is seen"
        assert not visible & set(geoms[~used])


def test_redrawing_keeps_what_the_demonstration_did(env, task):
    redrawn = env.redraw_appearance(jax.random.key(6), task)
    assert np.abs(redrawn.color - task.color).min() > 0
    assert np.abs(redrawn.texture.frame - task.texture.frame).max(axis=(1, 2)).min() > 0
    for field in ("target", "thing", "thing_size", "container", "container_size"):
        np.testing.assert_array_equal(getattr(redrawn, field), getattr(task, field))

    state = env.reset(jax.random.key(7), task)
    states = State(*(jnp.stack([x] * 3) for x in (state.qpos, state.qvel, state.mocap_pos)))
    scenes = jax.jit(jax.vmap(env.redraw_scene, in_axes=(0, None, None)))(
        jax.random.split(jax.random.key(8), 300), task, states
    )
    target = int(task.target)
    np.testing.assert_array_equal(
        scenes.mocap_pos[:, :, target], np.broadcast_to(states.mocap_pos[:, target], (300, 3, 3))
    )
    np.testing.assert_array_equal(scenes.qpos, np.broadcast_to(states.qpos, scenes.qpos.shape))
    others = np.delete(np.asarray(scenes.mocap_pos), target, axis=2)
    assert np.abs(others - others[:, :1]).max() == 0, "they stand still"
    assert np.abs(others[1:, 0] - others[:-1, 0]).max(axis=(1, 2)).min() > 1e-3
    gap = np.linalg.norm(scenes.mocap_pos[:, 0, [0, 0, 1], :2] - scenes.mocap_pos[:, 0, [1, 2, 2], :2], axis=-1)
    assert (gap.min(axis=1) > place.SPACING - 1e-6).mean() > 0.99
    assert (others[..., :2] >= place.LOW).all() and (others[..., :2] <= place.HIGH).all()


def test_the_state_is_that_of_mujocos_arm(env):
    qpos = np.array(place._START) + np.random.default_rng(0).uniform(-0.3, 0.3, NUM_JOINTS)
    data = mujoco.MjData(env.mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(env.mj_model, data)
    axes = data.body("hand").xmat.reshape(3, 3)
    state = State(jnp.asarray(qpos), jnp.zeros(NUM_JOINTS), jnp.zeros((NUM_CONTAINERS, 3)))
    expected = np.concatenate([qpos, data.site("tip").xpos, axes[:, 0], axes[:, 2]])
    np.testing.assert_allclose(env.robot_state(state), expected, atol=2e-6)
    assert env.state_size == len(expected)


def test_calibration_tells_where_in_the_image_a_container_stands(env, task):
    """Finds the target's pixels by drawing it in another color; their center is where the calibration puts it."""
    plain = dataclasses.replace(task, texture=task.texture._replace(family=jnp.zeros(4, jnp.int32)))
    looks = [dataclasses.replace(plain, color=plain.color.at[1].set(level)) for level in (0.1, 0.9)]
    render, state = jax.jit(env.render), env.reset(jax.random.key(9), task)
    errors = []
    for spot in np.random.default_rng(0).uniform(place.LOW, place.HIGH, (8, 2)):
        away = jnp.array([[*spot, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0]])
        dark, light = (np.asarray(render(look, dataclasses.replace(state, mocap_pos=away)), int) for look in looks)
        rows, cols = np.nonzero(np.abs(light - dark).max(axis=-1) > 40)
        height, width = env.image_shape
        center = np.array([(2 * cols.mean() + 1) / width - 1, (2 * rows.mean() + 1) / height - 1, 1.0])
        errors.append(np.linalg.norm(center @ env.image_to_goal - spot))
    # Half a pixel is 8 mm; the camera looks down at an angle, which an affine map fits to a few centimetres.
    assert np.median(errors) < 0.02
    assert max(errors) < 0.05
