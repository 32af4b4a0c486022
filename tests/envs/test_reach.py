"""The reach environment against C MuJoCo, and its laws: success, and what the camera sees."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import milx
from milx.envs.base import State
from milx.envs.reach import env as reach
from milx.trajopt.linearize import linearize

EPISODES = 4
IMAGE_SHAPE = (48, 60)


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def env():
    return milx.make("reach", IMAGE_SHAPE)


@pytest.fixture(scope="module")
def task(env):
    return env.sample_task(jax.random.key(0), "train")


@pytest.fixture(scope="module")
def actions(env):
    """Samples controls; half of the episodes go beyond the range, where the environment clips."""
    scale = np.array([0.2, 1.0, 1.5, 3.0])[:, None, None]
    return scale * np.random.default_rng(0).uniform(-1, 1, (EPISODES, env.horizon, env.action_size))


@pytest.fixture(scope="module")
def states(env, task, actions):
    """Returns states [EPISODES, T + 1] under the actions, and what the robot knows in them."""

    @jax.jit
    @jax.vmap
    def episode(key, actions):
        def step(state, action):
            after = env.step(task, state, action)
            return after, after

        start = env.reset(key, task)
        _, after = jax.lax.scan(step, start, actions)
        states = jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs]), start, after)
        return states, jax.vmap(env.robot_state)(states)

    return episode(jax.random.split(jax.random.key(1), EPISODES), actions)


# Physics.


def test_same_controls_give_the_trajectory_of_c_mujoco(env, actions, states):
    states, _ = states
    model = mujoco.MjModel.from_xml_path(str(reach.ASSETS / "reach.xml"))
    assert np.abs(actions).max() > 2
    for i in range(EPISODES):
        data = mujoco.MjData(model)
        qpos, qvel = [data.qpos.copy()], [data.qvel.copy()]
        for action in actions[i]:
            data.ctrl[:] = np.clip(action, -1, 1)
            for _ in range(5):
                mujoco.mj_step(model, data)
            qpos.append(data.qpos.copy())
            qvel.append(data.qvel.copy())
        assert data.time == pytest.approx(50 * 0.05)
        assert np.ptp(qpos) > 1, "the arm must move for the comparison to mean something"
        np.testing.assert_allclose(states.qpos[i], qpos, rtol=0, atol=1e-9)
        np.testing.assert_allclose(states.qvel[i], qvel, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_the_planner_s_step_is_close_to_the_exact_one(env, task, actions, states):
    """Bounds the error of one step of the midpoint method, which falls with the third power of its length."""
    states, _ = states
    inside = np.abs(actions).max(axis=(1, 2)) < 0.5
    x = np.asarray(jnp.concatenate([states.qpos, states.qvel], axis=-1))[inside, :-1].reshape(-1, 4)
    u, scene = actions[inside].reshape(-1, 2), env.reset(jax.random.key(4), task)

    def model(step):
        return jax.jit(lambda x, u: linearize(lambda x, u: step(task, scene.with_vector(x), u).vector, x, u))(x, u)

    ((A, B), after), ((A_exact, B_exact), after_exact) = (model(step) for step in (env.approximate_step, env.step))
    np.testing.assert_allclose(after, after_exact, rtol=0, atol=2e-3)
    np.testing.assert_allclose(A, A_exact, rtol=0, atol=1e-4 * np.abs(A_exact).max())
    np.testing.assert_allclose(B, B_exact, rtol=0, atol=1e-3 * np.abs(B_exact).max())


@pytest.mark.slow
def test_jacobians_of_an_action_are_differences_of_c_mujoco(env, task, states):
    """Compares with central differences of step 1e-6, whose rounding error is about 1e-12 / 1e-6."""
    states, _ = states
    scene = env.reset(jax.random.key(4), task)
    model, data = env.mj_model, mujoco.MjData(env.mj_model)

    def advance(x, u):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = x[:2], x[2:], u
        for _ in range(env.substeps):
            mujoco.mj_step(model, data)
        return np.concatenate([data.qpos, data.qvel])

    jacobians = jax.jit(lambda x, u: linearize(lambda x, u: env.step(task, scene.with_vector(x), u).vector, x, u)[0])
    x = np.asarray(jax.vmap(lambda s: s.vector)(jax.tree.map(lambda v: v[1, ::10], states)))
    u = np.random.default_rng(3).uniform(-0.9, 0.9, (len(x), 2))
    A, B = jacobians(x, u)
    for i in range(len(x)):
        z = np.concatenate([x[i], u[i]])
        columns = [(advance(*np.split(z + e, [4])) - advance(*np.split(z - e, [4]))) / 2e-6 for e in 1e-6 * np.eye(6)]
        np.testing.assert_allclose(np.concatenate([A[i], B[i]], axis=1), np.transpose(columns), atol=1e-7, rtol=1e-6)
    assert np.abs(B).max() > 1e-3


def test_float32_follows_c_mujoco_through_an_episode(env, task, actions, states):
    """Follows 1,000 Runge-Kutta steps in what ships: they round off to less than 0.1 mm at the fingertip."""
    exact, _ = states
    with jax.enable_x64(False):
        single = milx.make("reach", IMAGE_SHAPE)
        start = jax.tree.map(lambda x: jnp.asarray(x[:, 0], jnp.float32), exact)
        controls = jnp.asarray(actions, jnp.float32)

        @jax.jit
        @jax.vmap
        def episode(state, actions):
            last, _ = jax.lax.scan(lambda s, a: (single.step(None, s, a), None), state, actions)
            return single.fingertip(last.qpos)

        found = np.asarray(episode(start, controls))
    expected = np.stack([env.fingertip(exact.qpos[i, -1]) for i in range(EPISODES)])
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_robot_state_is_that_of_c_mujoco(env, states):
    states, robot = states
    data = mujoco.MjData(env.mj_model)
    site = env.mj_model.site("fingertip").id
    velocity = np.zeros(6)
    for i, t in np.ndindex(EPISODES, env.horizon + 1):
        data.qpos[:], data.qvel[:] = states.qpos[i, t], states.qvel[i, t]
        mujoco.mj_forward(env.mj_model, data)
        mujoco.mj_objectVelocity(env.mj_model, data, mujoco.mjtObj.mjOBJ_SITE, site, velocity, 0)
        expected = np.concatenate([data.qpos, data.qvel, data.site_xpos[site, :2], velocity[3:5]])
        np.testing.assert_allclose(robot[i, t], expected, rtol=1e-9, atol=1e-9)


def test_state_reach_tells_the_robot_s_state_and_the_cubes_by_number(env, task):
    blind = milx.make("reach_state")
    state = jax.jit(env.reset)(jax.random.key(3), task)
    state = dataclasses.replace(state, qpos=jnp.array([0.4, -1.1]), qvel=jnp.array([0.3, 0.2]))
    seen = blind.observe(task, state)
    assert seen.image is None
    np.testing.assert_allclose(seen.state[:8], env.robot_state(state), atol=1e-12)
    for cube, (x, y) in enumerate(blind.object_indices):
        aim = dataclasses.replace(task, target=jnp.int32(cube))
        off = seen.state[jnp.array(blind.goal_indices)] - seen.state[jnp.array([x, y])]
        np.testing.assert_allclose(off, env.off_target(aim, state), atol=1e-12)
        np.testing.assert_array_equal(blind.observe(aim, state).state, seen.state)  # nothing tells the target


# Tasks and scenes.


@pytest.fixture(scope="module")
def succeeds(env, task):
    """Makes a function of (set of steps, gap in m): success of an episode with the fingertip that far off then.

    In all other steps the fingertip touches a distractor, 0.3 m away.
    """
    success = jax.jit(lambda states: env.success(dataclasses.replace(task, target=1), states))

    def run(steps, gap):
        touching = np.isin(np.arange(51), list(steps))
        qpos = np.where(touching[:, None], [0.0, 0.0], [np.pi / 2, 0.0])
        # The arm is 0.21 m long: its fingertip is at (0.21, 0) or at (0, 0.21).
        cubes = np.array([[0, 0.21, 0.03], [0.21, -gap, 0.03], [-0.1, -0.1, 0.03]])
        states = State(jnp.asarray(qpos), jnp.zeros((51, 2)), jnp.broadcast_to(cubes, (51, 3, 3)))
        return bool(success(states))

    return run


def test_success_is_a_touch_in_one_of_the_last_ten_states(succeeds):
    for step in range(41, 51):
        assert succeeds({step}, 0.0), step
    assert not succeeds(range(41), 0.0)
    assert not succeeds({40}, 0.0)
    assert not succeeds((), 0.0)


def test_success_is_closer_than_five_centimetres(succeeds):
    assert succeeds({50}, 0.0499)
    assert not succeeds({50}, 0.0501)
    assert not succeeds(range(51), 0.0501)


# What the camera sees.


def pixel(point):
    """Returns (row, column) of a point: the camera looks down from 1.2 m with 24 degrees from top to bottom."""
    height, width = IMAGE_SHAPE
    per_metre = height / (2 * np.tan(np.deg2rad(12)) * (1.2 - point[2]))
    return int(height / 2 - per_metre * point[1]), int(width / 2 + per_metre * point[0])


def test_the_image_shows_cubes_and_fingertip_where_they_are():
    rng = np.random.default_rng(0)
    n = 24
    with jax.enable_x64(False):
        env = milx.make("reach", IMAGE_SHAPE)
        keys = jax.random.split(jax.random.key(6), n)
        tasks = jax.vmap(lambda key: env.sample_task(key, "test"))(keys)
        primaries = np.stack([rng.permutation(np.eye(3)) for _ in range(n)])
        tasks = dataclasses.replace(tasks, object_color=jnp.asarray(primaries, jnp.float32))
        states = jax.jit(jax.vmap(env.reset))(keys, tasks)
        states = dataclasses.replace(states, qpos=jnp.asarray(rng.uniform(-3, 3, (n, 2)), jnp.float32))
        observation = jax.jit(jax.vmap(env.observe))(tasks, states)
    assert observation.image.dtype == np.uint8
    image, robot = np.asarray(observation.image, float), np.asarray(observation.state)
    np.testing.assert_allclose(robot[:, :2], states.qpos, atol=1e-6)
    targets_seen = 0
    for i in range(n):
        elbow = 0.1 * np.array([np.cos(robot[i, 0]), np.sin(robot[i, 0])])
        along = np.linspace(0, 1, 20)[:, None]
        arm = np.concatenate([along * elbow, elbow + along * (robot[i, 4:6] - elbow)])
        for cube in range(3):
            center = np.asarray(states.mocap_pos[i, cube])
            if np.linalg.norm(arm - center[:2], axis=-1).min() < 0.06:
                continue  # the arm, above the cubes, may hide this one
            row, column = pixel([*center[:2], 0.06])
            color = image[i, row, column]
            cosine = color @ primaries[i, cube] / np.linalg.norm(color)
            assert cosine > 0.98, f"scene {i}, cube {cube}: {color}"
            targets_seen += cube == int(tasks.target[i])
            # 7 cm from its center the cube has ended.
            away = [*(center[:2] - 0.07 * np.sign(center[:2]) * [1, 0]), 0.0]
            others = np.delete(np.asarray(states.mocap_pos[i, :, :2]), cube, axis=0)
            if np.abs(others - away[:2]).max(axis=-1).min() > 0.06:
                color = image[i, *pixel(away)]
                assert color @ primaries[i, cube] / np.linalg.norm(color) < 0.9
        # The fingertip is yellow: much red, some green, little blue.
        red, green, blue = image[i, *pixel([*robot[i, 4:6], 0.09])]
        assert red > green > 2 * blue
    assert targets_seen >= 6


# Errors.


def test_unknown_names_are_told_the_known_ones(env):
    with pytest.raises(ValueError, match="split: got 'trian', expected one of train, validation, test"):
        env.sample_task(jax.random.key(0), "trian")
    with pytest.raises(ValueError, match="env: got 'nope', expected one of reach"):
        milx.make("nope")


def test_postures_bring_the_fingertip_over_the_cubes(env, task):
    """The arm reaches from 0.21 - 0.2 to 0.21 m; a cube nearer or farther is as near as the arm can come to it."""
    states = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(jax.random.split(jax.random.key(5), 500), task)
    cubes = np.asarray(states.mocap_pos[..., :2])
    postures = jax.vmap(jax.vmap(env._posture, in_axes=(None, 0)))(states.qpos, cubes)
    tip = np.asarray(jax.vmap(jax.vmap(env.fingertip))(postures))
    distance = np.linalg.norm(cubes, axis=-1)
    beyond = np.maximum(np.maximum(distance - 0.21, 0.01 - distance), 0)
    np.testing.assert_allclose(np.linalg.norm(tip - cubes, axis=-1), beyond, rtol=0, atol=1e-7)


def test_the_guess_ends_at_the_target_under_c_mujoco(env):
    """Within 1 cm, in every scene whose target is within reach."""
    tasks = jax.vmap(lambda key: env.sample_task(key, "train"))(jax.random.split(jax.random.key(6), 40))
    starts = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(7), 40), tasks)
    guesses = np.asarray(jax.jit(jax.vmap(env.guess))(tasks, starts))
    model, tried = env.mj_model, 0
    data, tip = mujoco.MjData(model), model.site("fingertip").id
    for number, guess in enumerate(guesses):
        target = np.asarray(starts.mocap_pos[number, tasks.target[number], :2])
        if not 0.01 < np.linalg.norm(target) < 0.21:
            continue
        mujoco.mj_resetData(model, data)
        for ctrl in guess:
            data.ctrl[:] = ctrl
            mujoco.mj_step(model, data, nstep=env.substeps)
        mujoco.mj_forward(model, data)
        assert np.linalg.norm(data.site_xpos[tip, :2] - target) < 0.01, number
        tried += 1
    assert tried > 20
