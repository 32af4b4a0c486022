"""What planners by sampling rely on, in C MuJoCo: controls that do what they say, and approximations that are near."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import milx


@pytest.fixture(scope="module")
def push():
    return milx.make("push", (8, 8))


@pytest.fixture(scope="module")
def free(push):
    """Returns a state of push whose objects are out of reach."""
    key = jax.random.key(0)
    start = push.reset(key, push.sample_task(key, "train"))
    return start.with_vector(start.vector.at[jnp.array([7, 8, 10, 11])].set(jnp.array([1.0, 1.0, 1.0, -1.0])))


def drive(env, state, controls, expected=None):
    """Yields states in C MuJoCo, under constant controls that return to an expected state."""
    data = mujoco.MjData(env.mj_model)
    data.qpos[:], data.qvel[:] = state.qpos, state.qvel
    steering = env.steering

    @jax.jit
    def act(state):
        back = 0.0 if expected is None else steering.correction(state, expected)
        return jnp.clip(steering.action(state, controls + back), *env.action_range)

    while True:
        data.ctrl[:] = act(state)
        mujoco.mj_step(env.mj_model, data, nstep=env.substeps)
        state = state.with_vector(jnp.concatenate([jnp.asarray(data.qpos, float), jnp.asarray(data.qvel, float)]))
        yield state


def hand(env, state):
    """Returns x, y, z (m) of push's hand, its turn about z (rad), and how far it leans (no unit)."""
    pose = np.asarray(env.hand(state.qpos))
    return np.array([*pose[:3], np.arctan2(pose[4], pose[3])]), np.linalg.norm(pose[6:8])


@pytest.mark.slow
def test_the_hand_of_push_moves_as_its_controls_say_and_stays_upright(push, free):
    velocity = np.array([0.2, 0.1, 0.05, 0.8])
    states = drive(push, free, jnp.asarray(velocity))
    for _ in range(10):  # eight time constants of the law
        before = next(states)
    for _ in range(10):
        after = next(states)
    moved = hand(push, after)[0] - hand(push, before)[0]
    np.testing.assert_allclose(moved / 0.5, velocity, atol=0.01, rtol=0.05)
    assert hand(push, after)[1] < 0.03


@pytest.mark.slow
def test_the_hand_of_push_returns_to_where_it_is_expected(push, free):
    """It is expected on the other side of the half turn, where angles jump."""

    def turned(angle):
        """Turns the last joint, whose axis points down."""
        return free.with_vector(free.vector.at[6].add(hand(push, free)[0][3] - angle))

    start, expected = turned(3.0), turned(2 * np.pi - 3.0)
    np.testing.assert_allclose([hand(push, state)[0][3] for state in (start, expected)], [3.0, -3.0], atol=0.02)
    states = drive(push, start, jnp.zeros(4), expected)
    for _ in range(20):
        state = next(states)
    np.testing.assert_allclose(hand(push, state)[0], hand(push, expected)[0], atol=0.02)


def test_the_joints_of_reach_return_to_where_they_are_expected():
    env = milx.make("reach", (8, 8))
    key = jax.random.key(0)
    start = env.reset(key, env.sample_task(key, "train"))
    expected = start.with_vector(jnp.array([0.2, -0.3, 0.0, 0.0]))
    states = drive(env, start, jnp.zeros(2), expected)
    for _ in range(env.horizon):
        state = next(states)
    np.testing.assert_allclose(state.qpos, expected.qpos, atol=0.02)


def test_the_hand_of_place_returns_to_where_it_is_expected():
    """The joints are moved away by up to 0.2 rad; half a second has three time constants of the return."""
    env = milx.make("place", (8, 8))
    key = jax.random.key(0)
    task = env.sample_task(key, "train")
    expected = env.reset(key, task)
    off = np.random.default_rng(0).uniform(-0.2, 0.2, 7)
    state = expected.with_vector(expected.vector.at[:7].add(off))

    @jax.jit
    def step(state):
        action = env.steering.action(state, env.steering.correction(state, expected))
        return env.step(task, state, action)

    def away(state):
        """The distance of the hand (m), and of the axes of its frame."""
        (tip, axes, _), (goal, wanted, _) = env.hand(state.qpos), env.hand(expected.qpos)
        return np.array([np.linalg.norm(tip - goal), np.linalg.norm(axes - wanted)])

    before = away(state)
    assert (before > [0.02, 0.1]).all()
    for _ in range(5):
        state = step(state)
    assert (away(state) < 0.1 * before).all()


def test_the_approximation_of_push_moves_the_arm_as_the_environment_does(push, free, monkeypatch):
    """MuJoCo moves the free arm for half a second by either settings, to within a thousandth of its way."""
    used, given = [], []

    def advance(self, model, state, action, substeps):
        used.append((model.opt, substeps))
        given.append((model.replace(opt=push.model.opt), state, action))
        return state

    monkeypatch.setattr(type(push), "_advance", advance)
    task, action = push.sample_task(jax.random.key(0), "train"), jnp.array([0.3, 0.2, -0.2, 0.1, 0.2, -0.3, 0.1])
    for step in (type(push).step, type(push).approximate_step):
        step.__wrapped__(push, task, free, action)
    jax.tree.map(np.testing.assert_array_equal, *given)
    ends = []
    for option, substeps in used:
        model = copy.copy(push.mj_model)
        model.opt.timestep = float(option.timestep)
        model.opt.iterations, model.opt.ls_iterations = int(option.iterations), int(option.ls_iterations)
        data = mujoco.MjData(model)
        data.qpos[:], data.ctrl[:] = free.qpos, action
        mujoco.mj_step(model, data, nstep=10 * substeps)
        np.testing.assert_allclose(data.time, 0.5, rtol=1e-6)
        ends.append(data.qpos[:7] - np.asarray(free.qpos[:7]))
    assert used[1][1] < used[0][1]
    assert used[1][0].iterations < used[0][0].iterations
    assert np.abs(ends[1] - ends[0]).max() < 1e-3 * np.abs(ends[0]).max()
