"""Grasp against C MuJoCo, and the laws of its tasks and scenes."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import planned
import pytest
from blind_grasp import CLOSING, LIFTED, act, c_model, first, in_c, wanted

from milx.core.mjx import mjx
from milx.envs.grasp import env as grasp
from milx.envs.grasp.env import Grasp
from milx.envs.shapes import BY_SPLIT, SHAPES
from milx.trajopt.expert import VERSION


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def env(float64):
    return Grasp((18, 20))


@pytest.fixture(scope="module")
def tasks(env):
    return jax.vmap(env.sample_task, in_axes=(0, None))(jax.random.split(jax.random.key(0), 24), "train")


@pytest.fixture(scope="module")
def starts(env, tasks):
    return jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), len(tasks.target)), tasks)


@pytest.fixture(scope="module")
def follow(env):
    """Moves the hand to goals [N, 80, 4] in N scenes: states with axes [N, 80]."""

    def one(task, start, goals):
        def step(state, goal):
            state = env.step(task, state, act(state, goal))
            return state, state

        return jax.lax.scan(step, start, goals)[1]

    return jax.jit(jax.vmap(one))


@pytest.fixture(scope="module")
def shown(follow, tasks, starts):
    """Grasps blindly in every scene."""
    return follow(tasks, starts, jax.vmap(wanted)(tasks, starts))


@pytest.mark.slow
def test_the_hand_and_what_lies_on_the_table_move_as_in_mujoco(env, tasks, starts, shown):
    """Compares the time until the fingers close."""
    for number in range(4):
        expected = in_c(env, first(tasks, number), first(starts, number))[:CLOSING]
        np.testing.assert_allclose(shown.qpos[number, :CLOSING], expected, atol=1e-4)


@pytest.mark.slow
def test_a_grasp_lifts_as_many_things_as_in_mujoco(env, tasks, starts, shown):
    """Counts lifted things: how a grasp goes on after its first contact depends on the last digit.

    MJX computes contacts of capsules with boxes otherwise, so that fingers slip off letters on whose edges they came
    down; by MuJoCo Warp (test_warp.py) they hold as in C.
    """
    expected = [in_c(env, first(tasks, n), first(starts, n))[LIFTED - 1, 7] > 0.06 for n in range(len(tasks.target))]
    found = shown.qpos[:, LIFTED - 1, 7] > 0.06
    assert min(np.mean(expected), found.mean()) > 0.75
    assert abs(np.mean(expected) - found.mean()) < 0.2


def test_most_blind_grasps_succeed_and_end_on_the_target_alone(env, tasks, shown):
    assert jax.vmap(env.success)(tasks, shown).mean() > 0.6
    other = dataclasses.replace(tasks, target=(tasks.target + 1) % 3)
    assert not jax.vmap(env.success)(other, shown).any()


def test_success_needs_an_open_hand_and_a_thing_that_lies_still_on_the_mat(env, tasks, starts):
    task, state = first(tasks), first(starts)
    place = state.mocap_pos[task.target].at[2].add(env.resting(task))

    def judged(thing, finger, speed=0.0):
        qpos = state.qpos.at[5:8].set(thing).at[3].set(finger)
        last = dataclasses.replace(state, qpos=qpos, qvel=state.qvel.at[7].set(speed))
        return bool(env.success(task, jax.tree.map(lambda x: x[None], last)))

    assert judged(place, 0.04)
    assert judged(place + jnp.array([0.0, 0.9 * grasp.ON_MAT, 0.0]), 0.04)
    assert not judged(place + jnp.array([0.0, 1.1 * grasp.ON_MAT, 0.0]), 0.04)
    assert not judged(place + jnp.array([0.0, 0.0, 1.1 * grasp.RESTING]), 0.04)
    assert not judged(place, 0.02)
    assert not judged(place, 0.04, speed=-1.1 * grasp.STILL)


def test_the_hand_moves_as_its_controls_say_and_returns_to_its_path(env, tasks, starts):
    """Drives it in C MuJoCo, first for twelve time constants of the servos; then its error decays at a known rate."""
    task, start = first(tasks), first(starts)
    model, steering = c_model(env, task), env.steering
    data = mujoco.MjData(model)
    data.qpos[:] = start.qpos
    velocity = np.array([0.05, -0.1, 0.05])
    controls = np.append(velocity / grasp.MAX_SPEED, 0.0)
    data.ctrl[:] = steering.action(start, jnp.asarray(controls))
    mujoco.mj_step(model, data, nstep=30)
    np.testing.assert_allclose(data.qvel[:3], velocity, rtol=0.02)
    assert data.qpos[3] > grasp.OPEN, "the fingers are open at 0"
    away = np.array([0.02, -0.01, 0.01])
    expected = dataclasses.replace(start, qpos=jnp.asarray(data.qpos) + jnp.pad(away, (0, env.mj_model.nq - 3)))
    data.qvel[:3] = 0
    for _ in range(20):
        state = dataclasses.replace(start, qpos=jnp.asarray(data.qpos))
        data.ctrl[:] = steering.action(state, steering.correction(state, expected))
        mujoco.mj_step(model, data)
    left = (np.asarray(expected.qpos) - data.qpos)[:3] / away
    np.testing.assert_allclose(left, np.exp(-20 * model.opt.timestep * grasp.TRACKING), atol=0.06)


def test_the_cost_is_what_its_weights_say(env, tasks, starts):
    """Compares with NumPy, tilted and moving, far from the mat, over it, near it and on it; derivatives are finite."""
    task, state, action = first(tasks), first(starts), jnp.linspace(-1, 1, 4)
    rest = state.mocap_pos[task.target].at[2].add(env.resting(task))
    spots = ((0.03, 0.04, 0.1), (0.03, 0.01, 0.003), (0.02, 0.01, 0.007), (0.02, 0.01, 0.005))
    for place, placed in ((state.qpos[5:8], 0), *zip(rest + jnp.array(spots), (0, 0, 0, 1), strict=True)):
        qpos = state.qpos.at[5:8].set(place).at[3].set(0.01).at[8:12].set(np.array([0.5, 0.1, -0.7, 0.5]))
        qvel = jnp.linspace(-0.5, 0.5, 11)
        off = np.asarray(place - rest)
        carried = np.interp(np.hypot(*off[:2]), (grasp.NEAR, grasp.FAR), (0.0, grasp.CARRIED))
        closed = grasp.OPEN_COST * (0.045 - 0.01 * placed)
        expected = [*grasp.THING_COST * off[:2], grasp.HEIGHT_COST * (off[2] - carried), closed]
        over = np.array([0, 0, grasp.RETREAT * placed])
        expected += [*grasp.HAND_COST * (np.asarray(qpos[:3] - place) - over), 0.3, -2.1]
        expected += [*placed * np.asarray(qvel[5:8]), *0.03 * placed * np.asarray(qvel[8:])]
        expected += [*0.02 * np.asarray(action)]
        at = dataclasses.replace(state, qpos=qpos, qvel=qvel)
        np.testing.assert_allclose(env.running_residual(task, at, action, 0), expected, atol=5e-5)
    slope = jax.jacfwd(lambda qpos: env.running_residual(task, dataclasses.replace(state, qpos=qpos), action, 0))
    on_mat = state.qpos.at[5:8].set(state.mocap_pos[task.target])
    assert np.isfinite(slope(on_mat)).all()


@pytest.mark.slow
def test_things_rest_where_they_are_laid(follow, tasks, starts):
    """Leaves the open hand where it is for half a second: neither thing nor hand moves by more than 1 mm."""
    here = jnp.insert(starts.qpos[:, :3], 3, -1.0, axis=1)
    after = follow(tasks, starts, jnp.repeat(here[:, None], 80, axis=1)).qpos[:, 9]
    assert np.abs(after[:, 5:8] - starts.qpos[:, 5:8]).max() < 1e-3
    assert np.abs(after[:, :3] - starts.qpos[:, :3]).max() < 1e-3


def test_scenes_keep_their_distances(env, tasks, starts):
    mats = starts.mocap_pos
    gaps = lambda mats: jnp.linalg.norm(mats[:, [0, 0, 1]] - mats[:, [1, 2, 2]], axis=-1)  # noqa: E731
    assert gaps(mats).min() >= grasp.SPACING
    low, high = np.array(grasp.MATS_LOW), np.array(grasp.MATS_HIGH)
    assert (mats[..., :2] >= low).all() and (mats[..., :2] <= high).all()
    moved = jax.vmap(env.redraw_scene)(
        jax.random.split(jax.random.key(2), len(tasks.target)), tasks, jax.tree.map(lambda x: x[:, None], starts)
    )
    rows = np.arange(len(tasks.target))
    np.testing.assert_array_equal(moved.mocap_pos[rows, 0, tasks.target], mats[rows, tasks.target])
    assert gaps(moved.mocap_pos[:, 0]).min() >= grasp.SPACING
    distance = np.linalg.norm(moved.mocap_pos[rows, 0, tasks.target - 1] - mats[rows, tasks.target - 1], axis=-1)
    assert np.mean(distance > 0.01) > 0.9


@pytest.mark.parametrize("split", ["train", "validation", "test"])
def test_kinds_of_things_and_mats_are_those_of_the_split(env, split):
    drawn = jax.vmap(env.sample_task, in_axes=(0, None))(jax.random.split(jax.random.key(3), 50), split)
    kinds = np.column_stack([drawn.thing, drawn.mat])
    assert {list(SHAPES)[kind] for kind in kinds.ravel()} <= set(BY_SPLIT[split])
    assert all(len(set(row)) == 4 for row in kinds)


@pytest.mark.slow
def test_mats_lie_on_the_shelf_with_their_whole_outlines(env, tasks, starts):
    """Measures in C MuJoCo how far their capsules reach, and stand out."""
    for number in range(len(tasks.target)):
        task, start = first(tasks, number), first(starts, number)
        model = c_model(env, task)
        data = mujoco.MjData(model)
        data.qpos[:], data.mocap_pos[:] = start.qpos, start.mocap_pos
        mujoco.mj_forward(model, data)
        shelf, colors = model.geom("shelf"), np.asarray(jax.jit(env.colors)(task))
        for i in range(3):
            geoms = np.flatnonzero(model.geom_bodyid == model.body(f"mat_{i}").id)
            seen = geoms[colors[geoms, 3] > 0]
            assert len(seen) == len(list(SHAPES.values())[int(task.mat[i])].capsules)
            radius, half = model.geom_size[seen, :2].T[:, :, None]
            ends = np.concatenate(
                [data.geom_xpos[seen] + way * half * data.geom_xmat[seen][:, 2::3] for way in (-1, 1)]
            )
            tops = data.geom_xpos[seen, 2] + radius[:, 0]
            np.testing.assert_allclose(tops, grasp.SHELF + grasp.MAT_HEIGHT, atol=1e-9)
            reach = np.abs(ends - shelf.pos)[:, :2] + np.concatenate([radius, radius])
            assert (reach <= shelf.size[:2]).all()


def test_textures_turn_with_the_thing_and_the_mats(env, tasks, starts):
    task, start = first(tasks), first(starts)
    data = mujoco.MjData(env.mj_model)
    data.qpos[:], data.mocap_pos[:] = start.qpos, start.mocap_pos
    mujoco.mj_kinematics(env.mj_model, data)
    textures = env.textures(task, mjx.put_data(env.mj_model, data))
    local = np.array([0.02, -0.01, 0.03])
    for name, own in zip(("thing", "mat_0", "mat_1", "mat_2"), task.texture.frame, strict=True):
        body = data.body(name)
        place = body.xpos + body.xmat.reshape(3, 3) @ local
        geoms = np.flatnonzero(env.mj_model.geom_bodyid == env.mj_model.body(name).id)
        for geom in geoms:
            np.testing.assert_allclose(textures.frame[geom] @ np.append(place, 1), own @ np.append(local, 1), atol=1e-4)
    assert not textures.family[env.mj_model.geom("shelf").id], "all else is plain"


def test_calibration_tells_where_in_the_image_a_mat_lies(tasks, starts):
    """Finds the target's pixels by drawing it in another color; their center is where the calibration puts it."""
    env, task, start = Grasp((90, 100)), first(tasks), first(starts)
    task = dataclasses.replace(task, target=jnp.int32(0), texture=task.texture._replace(family=jnp.zeros(4, jnp.int32)))
    looks = [dataclasses.replace(task, color=task.color.at[1].set(level)) for level in (0.1, 0.9)]
    render, errors = jax.jit(env.render), []
    for spot in np.random.default_rng(0).uniform(grasp.MATS_LOW, grasp.MATS_HIGH, (8, 2)):
        away = jnp.array([[*spot, grasp.SHELF], [2.0, 1.0, 0.0], [2.0, -1.0, 0.0]])
        dark, light = (np.asarray(render(look, dataclasses.replace(start, mocap_pos=away)), int) for look in looks)
        rows, cols = np.nonzero(np.abs(light - dark).max(axis=-1) > 40)
        center = np.array([(2 * cols.mean() + 1) / 100 - 1, (2 * rows.mean() + 1) / 90 - 1, 1.0])
        errors.append(np.linalg.norm(center @ env.image_to_goal - spot))
    # A pixel is about 7 mm; the camera looks down at an angle, which an affine map fits over the shelf.
    assert np.max(errors) < 0.02


def test_what_is_planned_is_what_its_version_says(env, tasks, starts, shown):
    """Looks at tasks, scenes, costs and controls, and at the way of the hand to the things."""
    steering = env.steering
    control = 0.5 * steering.deviation
    action = jax.vmap(lambda start: steering.action(start, control))(starts)
    cost = jax.vmap(env.running_residual, in_axes=(0, 0, 0, None))
    numbers = [np.ravel(x) for x in jax.tree.leaves(first((tasks, starts)))]
    numbers += [np.ravel(cost(tasks, starts, action, time)[:4]) for time in (0, env.horizon - 1)]
    numbers += [action[0], steering.low, steering.high, steering.deviation, np.ravel(shown.qpos[0, [5, 15]])]
    planned.check("grasp", [env.version, VERSION], np.concatenate(numbers), atol=1e-5)


def turned(state):
    """Mirrors what MuJoCo's vectors qpos and qvel hold, left and right swapped."""
    qpos = np.array([1, -1, 1, 1, 1, 1, -1, 1, 1, -1, 1, -1])  # hand, fingers, thing: place and quaternion
    qvel = np.array([1, -1, 1, 1, 1, 1, -1, 1, -1, 1, -1])
    return state[0] * qpos, state[1] * qvel


def test_the_mirror_image_of_an_episode_is_an_episode(env, tasks, starts):
    """Acts in a world and in its mirror image, with the mirrored thing and actions, in C MuJoCo.

    They differ a little after a push, since the motor is on the left finger and the right one follows it.
    """
    task, start, rng = first(tasks), first(starts), np.random.default_rng(0)
    models = c_model(env, task), c_model(env, task)
    drawn = np.isin(env.mj_model.geom_bodyid, env._body)  # the hand is its own mirror image, with exchanged fingers
    models[1].geom_pos[drawn, 1] *= -1
    models[1].geom_quat[np.ix_(drawn, [1, 3])] *= -1
    _, signs = env.mirror
    worlds = [mujoco.MjData(model) for model in models]
    begin = np.array(start.qpos), np.zeros(env.mj_model.nv)
    begin[0][:3] = start.qpos[5:8] + np.array([-0.08, 0.01, 0.0])
    for data, (qpos, qvel), sign in zip(worlds, (begin, turned(begin)), (1, -1), strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        data.mocap_pos[:] = start.mocap_pos * np.array([1, sign, 1])
    moved = 0.0
    while moved < 0.01:  # a little, since how things go on after a push depends on the last digit
        action = np.clip(rng.normal(size=4) * 0.2 + [0.8, 0.1, 0, 0.8], -1, 1)  # pushes the thing with closed fingers
        for model, data, sign in zip(models, worlds, (np.ones(4), np.array(signs)), strict=True):
            data.ctrl[:] = action * sign
            mujoco.mj_step(model, data, env.substeps)
        moved = np.abs(worlds[0].qpos[5:8] - begin[0][5:8]).max()
        assert worlds[0].time < env.horizon * env.substeps * env.mj_model.opt.timestep
    qpos, qvel = turned((worlds[0].qpos, worlds[0].qvel))
    np.testing.assert_allclose(worlds[1].qpos, qpos, atol=3e-3)
    np.testing.assert_allclose(worlds[1].qvel[:8], qvel[:8], atol=6e-3)
    np.testing.assert_allclose(worlds[1].qvel[8:], qvel[8:], atol=0.4)  # of 4 rad/s
    for found, expected in ((qpos, begin[0]), (qvel, begin[1])):
        assert np.abs(found - expected).max() > 0.05


def test_the_robot_s_state_and_the_image_are_mirrored_alike(tasks, starts):
    """Looks at the hand alone, beside an edge of the table, with the thing and the mats out of sight."""
    env, task, start = Grasp((90, 100)), first(tasks), first(starts)
    start = dataclasses.replace(
        start, qpos=start.qpos.at[5].set(9.0), qvel=start.qvel.at[:4].set(0.3), mocap_pos=start.mocap_pos + 9.0
    )
    qpos, qvel = map(jnp.asarray, turned((start.qpos, start.qvel)))
    other = dataclasses.replace(start, qpos=qpos, qvel=qvel)
    states, _ = env.mirror
    np.testing.assert_allclose(env.robot_state(other), env.robot_state(start) * np.array(states), atol=1e-12)
    image, reflection = (np.asarray(jax.jit(env.render)(task, state), int) for state in (start, other))
    assert np.abs(image - image[:, ::-1]).max() > 50, "the hand is to one side"
    different = np.abs(reflection - image[:, ::-1]).max(axis=-1) > 3
    assert different.mean() < 2e-3, "rounding at edges"
