"""Push against C MuJoCo, and the laws of its tasks and scenes."""

import copy
import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import planned
import pytest
from mujoco import mjx

from milx.envs.base import State
from milx.envs.push import env as push
from milx.envs.push.env import NUM_JOINTS, Push
from milx.envs.shapes import BY_SPLIT, SHAPES
from milx.envs.shapes.primitives import NUM_CAPSULES, to_geoms
from milx.render.scene import Renderer, to_uint8
from milx.trajopt.expert import VERSION


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def env(float64):
    return Push((48, 48))


@pytest.fixture(scope="module")
def task(env):
    drawn = env.sample_task(jax.random.key(0), "train")
    shape = [list(SHAPES).index(name) for name in ("hammer", "letter_a")]
    return dataclasses.replace(drawn, target=jnp.int32(0), shape=jnp.array(shape), damping=jnp.array([0.7, 3.0]))


def c_model(env, task):
    """Compiles MuJoCo's own model of the task."""
    model, ours = copy.copy(env.mj_model), env.model_of(task)
    for name in ("geom_pos", "geom_quat", "geom_size", "body_mass", "body_inertia", "dof_damping"):
        getattr(model, name)[:] = getattr(ours, name)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def test_constants_that_follow_from_the_objects_are_those_of_mujoco(env, task):
    theirs, ours = c_model(env, task), env.model_of(task)
    for name in ("body_invweight0", "body_subtreemass"):
        found = np.asarray(getattr(ours, name))[env._body]
        np.testing.assert_allclose(found, getattr(theirs, name)[env._body], rtol=1e-12)


def test_a_turned_piece_is_a_disc_to_masses_and_friction(env, task):
    disc = list(SHAPES).index("pawn")
    model = env.model_of(dataclasses.replace(task, shape=jnp.array([disc, disc])))
    for i in range(2):
        size, mass, damping = (float(x[i]) for x in (task.size, task.mass, task.damping))
        assert model.body_inertia[env._body[i], 2] == pytest.approx(mass * size**2 / 2, rel=0.02)
        turning = damping * size**2 / 2
        np.testing.assert_allclose(model.dof_damping[env._dof[i]], [damping, damping, turning], rtol=0.02)


@functools.partial(jax.jit, static_argnums=0)
def push_along(env, task, start, actions):
    return jax.lax.scan(lambda state, action: (env.step(task, state, action),) * 2, start, actions)[1]


@pytest.mark.slow
@pytest.mark.parametrize("touched", [0, 1])
def test_an_episode_of_pushing_is_that_of_mujoco(env, task, touched):
    # One object lies before the hand, which pushes it, unevenly, and goes on its way.
    start = env.reset(jax.random.key(1), task)
    objects = jnp.array([[-0.1, 0.3, 1.2], [-0.1, -0.3, 0.3]]).at[touched, :2].set(jnp.array([-0.36, 0.02]))
    start = start.with_vector(start.vector.at[NUM_JOINTS : NUM_JOINTS + 6].set(objects.ravel()))
    wave = jnp.sin(jnp.arange(env.horizon) / 9)[:, None]
    actions = 0.5 * jnp.array([-0.1, 0.8, 0.0, -0.9, 0.0, 0.1, 0.2]) + 0.1 * wave
    found = push_along(env, task, start, actions)
    model = c_model(env, task)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start.qpos, start.qvel
    positions, velocities = [], []
    for action in np.asarray(actions):
        data.ctrl[:] = action
        for _ in range(env.substeps):
            mujoco.mj_step(model, data)
        positions.append(data.qpos.copy())
        velocities.append(data.qvel.copy())
    moved = np.linalg.norm(positions[-1][NUM_JOINTS:].reshape(2, 3)[:, :2] - objects[:, :2], axis=-1)
    assert moved[touched] > 0.04
    # MJX's nearest points of two capsules are those of MuJoCo but for 1e-6 in a denominator. The letter is light and
    # turns fast when it is hit: its turn may be off by 0.02 rad.
    off = np.abs(found.qpos - np.array(positions)).max(axis=0)
    turns = [NUM_JOINTS + 2, NUM_JOINTS + 5]
    assert off[turns].max() < 0.02
    assert np.delete(off, turns).max() < 5e-4
    assert np.abs(found.qvel - np.array(velocities)).max() < 0.1


def test_what_is_planned_is_what_its_version_says(env):
    """Compares a task, a scene, controls of planners, what they do to the robot, and what an expert is told.

    It looks at every fifth of 20 steps.
    """
    task = env.sample_task(jax.random.split(jax.random.key(8), 32)[0], "train")
    start, steering = env.reset(jax.random.key(9), task), env.steering

    @jax.jit
    def move(state, _):
        action = steering.action(state, 0.5 * steering.deviation)
        state = env.step(task, state, action)
        return state, (state.qpos, action)

    _, (qpos, actions) = jax.lax.scan(move, start, length=20)
    told = env.visible(task, start), env.misjudge(jax.random.key(10), start).qpos
    seen = task.shape, task.size, qpos[::5], actions[::5], steering.low, steering.high, steering.deviation, *told
    planned.check("push", [env.version, VERSION], np.concatenate([np.ravel(x) for x in seen]), atol=1e-4)


def test_the_hand_starts_low_enough_for_every_shape(env, task):
    """Checks that no prong ends above a capsule's axis, where the hand would be lifted instead of pushing."""
    data = mujoco.MjData(env.mj_model)
    data.qpos[:] = env.reset(jax.random.key(1), task).qpos
    mujoco.mj_kinematics(env.mj_model, data)
    prong = env.mj_model.geom("prong_middle").id
    end = data.geom_xpos[prong, 2] - env.mj_model.geom_size[prong, 1]
    for name, shape in SHAPES.items():
        heights = push.SIZE[0] * to_geoms(shape).pos[:NUM_CAPSULES, 2]
        # Some of a shape's capsules may be thinner, but not all. 2 mm tilt the contact by 8 degrees.
        assert end < heights.max() + 2e-3, name


@pytest.mark.slow
def test_the_image_is_that_of_the_tasks_own_model(env, task):
    """Compares geoms, sizes and colors of objects without a texture; what is not used is not seen."""
    task = dataclasses.replace(task, texture=task.texture._replace(family=jnp.zeros(2, jnp.int32)))
    model = c_model(env, task)
    model.geom_rgba[:] = jax.jit(env.colors)(task)
    state = env.reset(jax.random.key(5), task)
    data = mujoco.MjData(model)
    data.qpos[:] = state.qpos
    mujoco.mj_forward(model, data)
    renderer = Renderer(model, env.camera, *env.image_shape)
    frame = jax.jit(renderer.render)(renderer.scene(data))
    np.testing.assert_allclose(env.render(task, state).astype(int), to_uint8(frame.color).astype(int), atol=1)
    visible = set(np.unique(frame.geom_id))
    used = [set(env._geom[i][np.asarray(env._shapes_of(task).seen[i])]) for i in range(2)]
    assert all(visible & geoms for geoms in used)
    assert not visible & (set(env._geom.ravel()) - used[0] - used[1])


def test_redrawing_changes_looks_alone_and_the_task_blind_forget_the_target_alone(env, task):
    redrawn = env.redraw_appearance(jax.random.key(6), task)
    assert np.abs(redrawn.color - task.color).min() > 0
    assert np.abs(redrawn.texture.frame - task.texture.frame).min() > 0
    blind = jax.vmap(env.task_blind, in_axes=(0, None))(jax.random.split(jax.random.key(7), 400), task)
    assert abs(np.mean(blind.target) - 0.5) < 4 * 0.5 / 400**0.5
    for field in ("shape", "size", "mass", "damping"):
        np.testing.assert_array_equal(getattr(redrawn, field), getattr(task, field))
        np.testing.assert_array_equal(getattr(blind, field)[7], getattr(task, field))


def test_objects_start_on_either_side_away_from_the_goal_and_from_each_other(env):
    keys = jax.random.split(jax.random.key(2), 2000)
    tasks = jax.jit(jax.vmap(lambda key: env.sample_task(key, "test")))(keys)
    scene_keys = jax.random.split(jax.random.key(3), len(keys))
    place = np.asarray(jax.jit(jax.vmap(env.reset))(scene_keys, tasks).qpos[:, NUM_JOINTS:].reshape(-1, 2, 3))
    assert (place[..., :2] >= push.LOW).all() and (place[..., :2] <= push.HIGH).all()
    assert (place[:, 0, 1] * place[:, 1, 1] <= 0).all()
    assert np.linalg.norm(place[..., :2], axis=-1).min() > push.FROM_GOAL
    assert np.linalg.norm(place[:, 0, :2] - place[:, 1, :2], axis=-1).min() > push.SPACING
    # Neither where a object stands nor its number tells the target.
    target = np.asarray(tasks.target)
    assert abs(target.mean() - 0.5) < 4 * 0.5 / len(target) ** 0.5
    assert abs(np.corrcoef(target, place[:, 0, 1])[0, 1]) < 4 / len(target) ** 0.5
    names = np.array(list(SHAPES))[np.asarray(tasks.shape)]
    assert set(names.ravel()) == set(BY_SPLIT["test"])
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
    assert bool(env.success(other, states)), "the other object stands on the goal all the time"


def test_hand_of_the_start_points_down_and_pushes_away_from_the_arm(env, task):
    state = env.reset(jax.random.key(4), task)
    tip, push_to, prongs = np.split(np.asarray(env.hand(state.qpos)), 3)
    np.testing.assert_allclose(tip, [-0.42, 0, 0.02], atol=1e-3)
    np.testing.assert_allclose(push_to, [1, 0, 0], atol=2e-2)
    np.testing.assert_allclose(prongs, [0, 0, -1], atol=2e-2)


def test_textures_turn_with_their_objects(env, task):
    state = env.reset(jax.random.key(2), task)
    data = mujoco.MjData(env.mj_model)
    data.qpos[:] = state.qpos
    mujoco.mj_kinematics(env.mj_model, data)
    frames = env.textures(task, mjx.put_data(env.mj_model, data)).frame
    local = np.array([0.02, -0.01, 0.03])
    for i, body in enumerate(env._body):
        place = data.xpos[body] + data.xmat[body].reshape(3, 3) @ local
        own = np.asarray(task.texture.frame[i])
        for geom in env._geom[i]:
            np.testing.assert_allclose(np.asarray(frames[geom]) @ [*place, 1], own @ [*local, 1], atol=1e-4)


def test_the_released_codes_criterion_counts_steps_within_a_wider_circle(env, task):
    start = env.reset(jax.random.key(2), task)
    x = NUM_JOINTS + 3 * task.target

    def counts(steps, distance):
        """Tells whether either criterion counts a target that is so far from the goal in these time steps."""
        far = jnp.full(env.horizon + 1, 0.5).at[steps].set(distance)
        qpos = jnp.broadcast_to(start.qpos, (env.horizon + 1, len(start.qpos))).at[:, x].set(far).at[:, x + 1].set(0)
        states = State(qpos, jnp.zeros_like(qpos), jnp.zeros((env.horizon + 1, 0, 3)))
        (near,) = env.other_criteria(task, states).values()
        return bool(env.success(task, states)), bool(near)

    assert counts(slice(-10, None), 0.07) == (True, True)
    assert counts(slice(-10, None), 0.12) == (False, True)
    assert counts(slice(-10, None), 0.14) == (False, False)
    assert counts(slice(-9, None), 0.12) == (False, False)
    # The state at the start is no step.
    assert counts(slice(0, 10), 0.12) == (False, False)
    assert counts(slice(0, 11), 0.12) == (False, True)
