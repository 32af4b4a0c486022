"""Push against C MuJoCo, and the laws of its tasks and scenes."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from milx.envs import push
from milx.envs.base import State
from milx.envs.push import NUM_JOINTS, Push
from milx.envs.shapes import SHAPES, SPLITS


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def env(float64):
    return Push((16, 16))


@pytest.fixture(scope="module")
def task(env):
    drawn = env.sample_task(jax.random.key(0), "train")
    shape = [list(SHAPES).index(name) for name in ("hammer", "letter_a")]
    return dataclasses.replace(drawn, target=jnp.int32(0), shape=jnp.array(shape), damping=jnp.array([0.7, 3.0]))


def c_model(env, task):
    """MuJoCo's own model of the task."""
    model, ours = _copy(env.mj_model), env.model_of(task)
    for name in ("geom_pos", "geom_quat", "geom_size", "body_mass", "body_inertia", "dof_damping"):
        getattr(model, name)[:] = getattr(ours, name)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def _copy(model):
    size = mujoco.mj_sizeModel(model)
    buffer = np.empty(size, np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": buffer.tobytes()})


def test_constants_that_follow_from_the_things_are_those_of_mujoco(env, task):
    theirs, ours = c_model(env, task), env.model_of(task)
    for name in ("body_invweight0", "body_subtreemass"):
        found = np.asarray(getattr(ours, name))[env._body]
        np.testing.assert_allclose(found, getattr(theirs, name)[env._body], rtol=1e-12)


def test_an_episode_of_pushing_is_that_of_mujoco(env, task):
    # The hand stands behind the hammer and pushes it, unevenly.
    start = env.reset(jax.random.key(1), task)
    things = jnp.array([[-0.36, 0.02, 1.2], [-0.2, -0.1, 0.3]])
    start = start.with_vector(start.vector.at[NUM_JOINTS : NUM_JOINTS + 6].set(things.ravel()))
    actions = 0.35 * jnp.array([-0.1, 0.8, 0.0, -0.9, 0.0, 0.1, 0.2]) * jnp.ones((40, 1))
    _, found = jax.jit(lambda s: jax.lax.scan(lambda s, a: (env.step(task, s, a),) * 2, s, actions))(start)
    model = c_model(env, task)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start.qpos, start.qvel
    expected, contacts = [], 0
    for action in np.asarray(actions):
        data.ctrl[:] = action
        for _ in range(env.substeps):
            mujoco.mj_step(model, data)
            contacts += data.ncon > 0
        expected.append(data.qpos.copy())
    expected = np.array(expected)
    assert contacts > 50
    assert np.linalg.norm(expected[-1, NUM_JOINTS : NUM_JOINTS + 2] - things[0, :2]) > 0.1, "the hammer moved"
    # MJX's nearest points of two capsules are those of MuJoCo but for 1e-6 in a denominator.
    np.testing.assert_allclose(found.qpos, expected, atol=1e-4)


def test_things_start_on_either_side_away_from_the_goal_and_from_each_other(env):
    keys = jax.random.split(jax.random.key(2), 2000)
    tasks = jax.jit(jax.vmap(lambda key: env.sample_task(key, "test")))(keys)
    place = np.asarray(jax.jit(jax.vmap(env.reset))(keys, tasks).qpos[:, NUM_JOINTS:].reshape(-1, 2, 3))
    assert (place[..., :2] >= push.LOW).all() and (place[..., :2] <= push.HIGH).all()
    assert (place[:, 0, 1] * place[:, 1, 1] <= 0).all()
    assert np.linalg.norm(place[..., :2], axis=-1).min() > push.FROM_GOAL
    assert np.linalg.norm(place[:, 0, :2] - place[:, 1, :2], axis=-1).min() > push.SPACING
    # Neither where a thing stands nor its number tells the target.
    target = np.asarray(tasks.target)
    assert abs(target.mean() - 0.5) < 4 * 0.5 / len(target) ** 0.5
    assert abs(np.corrcoef(target, place[:, 0, 1])[0, 1]) < 4 / len(target) ** 0.5
    names = np.array(list(SHAPES))[np.asarray(tasks.shape)]
    assert set(names.ravel()) == set(SPLITS["test"])
    assert (names[:, 0] != names[:, 1]).all()


@pytest.mark.parametrize(("steps", "succeeds"), [(9, False), (10, True)])
def test_success_is_ten_steps_on_the_disc(env, task, steps, succeeds):
    x = np.where(np.arange(env.horizon + 1) <= steps, 0.079, 0.081)
    x[0] = 0.0  # the scene before the first step does not count
    qpos = np.zeros((env.horizon + 1, NUM_JOINTS + 6))
    qpos[:, NUM_JOINTS] = x
    states = State(jnp.asarray(qpos), jnp.zeros_like(qpos), jnp.zeros((env.horizon + 1, 0, 3)))
    assert bool(env.success(task, states)) is succeeds
    other = dataclasses.replace(task, target=jnp.int32(1))
    assert bool(env.success(other, states)), "the other thing stands on the goal all the time"


def test_hand_of_the_start_points_down_and_pushes_away_from_the_arm(env, task):
    state = env.reset(jax.random.key(4), task)
    tip, push_to, prongs = np.split(np.asarray(env.hand(state.qpos)), 3)
    np.testing.assert_allclose(tip, [-0.42, 0, 0.03], atol=2e-3)
    np.testing.assert_allclose(push_to, [1, 0, 0], atol=2e-2)
    np.testing.assert_allclose(prongs, [0, 0, -1], atol=2e-2)
