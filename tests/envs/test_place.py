"""Place against C MuJoCo, and the laws of its tasks, scenes and falls."""

import copy
import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import planned
import pytest

from milx.envs.base import State
from milx.envs.place import containers, drop
from milx.envs.place import env as place
from milx.envs.place.containers import CONTAINERS
from milx.envs.place.env import NUM_JOINTS, Place
from milx.envs.shapes import SHAPES
from milx.trajopt.expert import VERSION

FAR = jnp.array([10.0, 10.0, 0.0])


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def env(float64):
    return Place((18, 20))


@pytest.fixture(scope="module")
def task(env):
    return env.sample_task(jax.random.key(0), "train")


def c_model(model, ours):
    """Compiles MuJoCo's own model with the geoms of one of MJX."""
    model = copy.copy(model)
    for name in ("geom_pos", "geom_quat", "geom_size"):
        getattr(model, name)[:] = getattr(ours, name)
    model.geom_sameframe[:] = 0  # else MuJoCo takes the body's frame for those of geoms that were compiled at 0
    return model


class Arm:
    """The arm in C MuJoCo."""

    def __init__(self, env):
        self.model, self.data = env.mj_model, mujoco.MjData(env.mj_model)
        self.tip, self.hand = self.model.site("tip").id, self.model.body("hand").id

    def at(self, qpos):
        """Returns the position of the tip, the axes of the hand, and the Jacobian."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        jacobian = np.zeros((6, NUM_JOINTS))
        mujoco.mj_jacSite(self.model, self.data, jacobian[:3], jacobian[3:], self.tip)
        return self.data.site_xpos[self.tip].copy(), self.data.xmat[self.hand].reshape(3, 3).copy(), jacobian


def test_the_hand_and_its_jacobian_are_those_of_mujoco(env):
    arm = Arm(env)
    for qpos in np.random.default_rng(0).uniform(*env.mj_model.jnt_range.T, (10, NUM_JOINTS)):
        for found, expected in zip(env.hand(jnp.asarray(qpos)), arm.at(qpos), strict=True):
            np.testing.assert_allclose(found, expected, atol=1e-12)


def test_an_episode_of_motion_is_that_of_mujoco_with_numpy(env, task):
    """Steps damped least squares on C MuJoCo's Jacobian; hard turns drive joints into their limits."""
    start = env.reset(jax.random.key(1), task)
    rng = np.random.default_rng(1)
    actions = np.clip(np.linspace(-1.5, 1.5, 6) + 0.3 * rng.normal(size=(env.horizon, 6)), -2, 2)
    step = lambda state, action: (env.step(task, state, action),) * 2  # noqa: E731
    found = jax.jit(lambda state, actions: jax.lax.scan(step, state, actions)[1])(start, jnp.asarray(actions))
    arm, qpos, limit = Arm(env), np.array(start.qpos), np.repeat([place.MAX_SPEED, place.MAX_TURN], 3)
    at_limit = False
    for t, action in enumerate(np.clip(actions, -1, 1)):
        for _ in range(env.substeps):
            jacobian = arm.at(qpos)[2]
            normal = jacobian @ jacobian.T + place._DAMPING**2 * np.eye(6)
            free = qpos + env.mj_model.opt.timestep * jacobian.T @ np.linalg.solve(normal, limit * action)
            qpos = np.clip(free, *env.mj_model.jnt_range.T)
            at_limit |= bool((qpos != free).any())
        np.testing.assert_allclose(found.qpos[t], qpos, atol=1e-10)
    assert at_limit


def test_the_planner_s_step_differs_from_the_exact_one_by_its_second_order(env, task):
    """Checks the step of Euler's method: with half the action, a quarter of the difference is left."""
    start = env.reset(jax.random.key(1), task)
    actions = np.random.default_rng(2).uniform(-1, 1, (20, 6))

    @jax.jit
    @jax.vmap
    def difference(action):
        return env.approximate_step(task, start, action).qpos - env.step(task, start, action).qpos

    whole, eighth, sixteenth = (np.linalg.norm(difference(actions / n), axis=-1) for n in (1, 8, 16))
    assert whole.min() > 1e-3 and whole.max() < 0.05, "radians"
    np.testing.assert_allclose(sixteenth / eighth, 1 / 4, rtol=0.05)


def test_what_is_planned_is_what_its_version_says(env, task):
    """Compares tasks, scenes, guesses, physics and costs; the planner itself is in the test of reach's experts."""

    @jax.jit
    def look(task, key):
        start = env.reset(key, task)
        guess = env.guess(task, start)
        after = env.step(task, start, guess[0])
        approximately = env.approximate_step(task, start, jnp.linspace(-1, 1, 6))
        costs = env.running_residual(task, after, guess[1], jnp.int32(1)), env.terminal_residual(task, after)
        fallen, _ = env.falls(task, after)
        return task, start, guess[::10], after, approximately, costs, fallen

    numbers = [np.ravel(x).astype(float) for x in jax.tree.leaves(look(task, jax.random.key(1)))]
    planned.check("place", [env.version, VERSION], np.concatenate(numbers), atol=1e-5)


def test_a_small_action_moves_the_hand_at_the_speed_it_asks_for(env, task):
    start = env.reset(jax.random.key(2), task)
    before = env.hand(start.qpos)
    for i in range(6):
        after = env.hand(env.step(task, start, 0.1 * jnp.eye(6)[i]).qpos)
        moved = np.asarray(after[0] - before[0]) / (0.1 * place.MAX_SPEED * 0.1)
        turn = np.asarray(after[1] @ before[1].T) - np.eye(3)
        turned = np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) / (0.1 * place.MAX_TURN * 0.1)
        np.testing.assert_allclose(np.concatenate([moved, turned]), np.eye(6)[i], atol=0.1)


def held_over(env, task, key, offset=(0.0, 0.0)):
    """Points the hand down over the target, `offset` (m) off its middle, at the height of release."""
    state = env.reset(key, task)
    arm, qpos = Arm(env), np.array(place._START)
    goal = np.array(state.mocap_pos[task.target])
    goal += (*offset, float(env.release_height(task)))
    for _ in range(60):
        tip, axes, jacobian = arm.at(qpos)
        turn = 0.5 * sum(
            np.cross(axes[:, i], wanted) for i, wanted in enumerate(np.eye(3)[[2, 1, 0]] * [[-1], [1], [1]])
        )
        off = np.concatenate([goal - tip, turn])
        qpos += jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-6 * np.eye(6), off)
    assert np.abs(off).max() < 1e-6
    return dataclasses.replace(state, qpos=jnp.asarray(qpos))


@functools.partial(jax.jit, static_argnums=0)
def fall(env, tasks, states):
    return jax.vmap(env.falls)(tasks, states)


@pytest.fixture(scope="module")
def dropped(env):
    """Drops a thing of its split over the middle of every container, and returns where it comes to rest."""
    tasks, states = [], []
    for i, name in enumerate(CONTAINERS):
        split = next(split for split, names in containers.BY_SPLIT.items() if name in names)
        task = env.sample_task(jax.random.key(i), split)
        task = dataclasses.replace(task, container=task.container.at[task.target].set(i))
        tasks.append(task)
        states.append(held_over(env, task, jax.random.key(100 + i)))
    tasks, states = (jax.tree.map(lambda *x: jnp.stack(x), *trees) for trees in (tasks, states))
    return tasks, states, fall(env, tasks, states)


@pytest.mark.slow
def test_what_is_let_go_over_the_middle_of_a_container_comes_to_rest_in_it(env, dropped):
    tasks, states, (fallen, _) = dropped
    end, velocity = fallen.qpos[:, :3], fallen.qvel[:, :3]
    count = len(tasks.target)
    middle = states.mocap_pos[np.arange(count), tasks.target]
    assert np.linalg.norm(velocity, axis=-1).max() < drop.STILL
    half = tasks.container_size[np.arange(count), tasks.target]
    assert (np.linalg.norm(end[:, :2] - middle[:, :2], axis=-1) / half).max() < 1
    # It has fallen: its lowest capsule lies on the table or on a wall, none below the table.
    rim = half * env._containers.height[np.arange(count)]
    assert (end[:, 2] > 0).all()
    assert (end[:, 2] < rim + 0.06).all()


@pytest.mark.slow
def test_the_fall_is_that_of_mujoco(env, dropped):
    """Compares where things come to rest, and that they do within the rim; contacts with boxes differ."""
    tasks, states, (fallen, _) = dropped
    off, within = [], []
    for i in range(len(tasks.target)):
        task, state = (jax.tree.map(lambda x, i=i: x[i], tree) for tree in (tasks, states))
        tip, axes, _ = env.hand(state.qpos)
        turn = jnp.stack([axes[:, 2], axes[:, 1], -axes[:, 0]], axis=1)
        thing, *_ = env._geoms_of(task)
        container = jax.tree.map(lambda x, task=task: x[task.container[task.target]], env._containers)
        standing = container, task.container_size[task.target], state.mocap_pos[task.target]
        model = c_model(env._drop.mj_model, env._drop.model_of(*thing, *standing))
        start = env._drop.start(*thing, tip, turn)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = start
        for _ in range(round(drop.SECONDS / drop.TIMESTEP)):
            mujoco.mj_step(model, data)
        off.append(np.linalg.norm(data.qpos[:3] - fallen.qpos[i, :3]))
        aside = np.linalg.norm(data.qpos[:2] - state.mocap_pos[task.target, :2])
        within.append(aside < task.container_size[task.target] and np.linalg.norm(data.qvel[:3]) < drop.STILL)
    assert np.median(off) < 2e-3
    assert np.quantile(off, 0.9) < 0.02
    assert all(within), "as in MJX (the test before)"


def test_only_what_lies_still_within_the_targets_rim_counts(env, task):
    """Compares with the ellipse of a round rim and with the rectangle of a square one."""

    class Fallen(Place):
        def __init__(self):
            self.__dict__.update(env.__dict__)

        def falls(self, task, state):
            return drop.Fall(jnp.append(end, 0.02), jnp.array([speed, 0.0, 0.0])), None

    def counts(name, off, moving):
        nonlocal end, speed
        index = list(CONTAINERS).index(name)
        chosen = dataclasses.replace(task, container=task.container.at[task.target].set(index))
        state = env.reset(jax.random.key(4), task)
        end = state.mocap_pos[task.target, :2] + task.container_size[task.target] * jnp.asarray(off)
        speed = moving
        return bool(Fallen().success(chosen, jax.tree.map(lambda x: x[None], state)))

    end, speed = None, None
    assert counts("bowl", (0.7, 0.7), 0.0)
    assert not counts("bowl", (0.72, 0.72), 0.0)
    assert counts("box", (0.72, 0.99), 0.0)
    assert not counts("box", (0.0, 1.01), 0.0)
    assert counts("crate", (1.29, 0.0), 0.0)
    assert not counts("crate", (0.0, 1.29), 0.0)
    assert not counts("box", (0.0, 0.0), 1.01 * drop.STILL)


def test_scenes_keep_their_distances_and_redrawing_keeps_the_targets_place(env, task):
    keys = jax.random.split(jax.random.key(5), 300)
    scenes = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, task)

    def gap(places):
        return np.linalg.norm(places[:, [0, 0, 1], :2] - places[:, [1, 2, 2], :2], axis=-1).min(axis=1)

    assert (gap(scenes.mocap_pos) > place.SPACING).mean() > 0.99
    episode = jax.tree.map(lambda x: jnp.stack([x] * 3, axis=1), scenes)
    redrawn = jax.vmap(env.redraw_scene, in_axes=(0, None, 0))(keys[::-1], task, episode)
    moved = np.asarray(redrawn.mocap_pos - episode.mocap_pos)
    np.testing.assert_array_equal(moved[:, :, task.target], 0)
    np.testing.assert_array_equal(redrawn.qpos, episode.qpos)
    others = np.delete(moved, int(task.target), axis=2)[..., :2]
    assert np.abs(others).min() > 0
    np.testing.assert_array_equal(others[:, 0], others[:, 1])
    assert (gap(redrawn.mocap_pos[:, 0]) > place.SPACING).mean() > 0.95


def test_containers_are_held_out_by_kind():
    names = [name for split in containers.BY_SPLIT.values() for name in split]
    assert sorted(names) == sorted(CONTAINERS)
    assert len(containers.BY_SPLIT["test"]) == 18  # and 11 things: the paper's 29


@pytest.mark.parametrize("name", CONTAINERS)
def test_walls_lean_from_the_bottom_to_the_rim(name):
    container = CONTAINERS[name]
    geoms = containers.to_geoms(container)
    for pos, quat, size in zip(geoms.pos[: container.sides], geoms.quat, geoms.size, strict=False):
        outer = {}
        for end in (-1, 1):
            corner = np.zeros(3)
            mujoco.mju_rotVecQuat(corner, size * [0, 1, end], quat)
            inner = np.zeros(3)
            mujoco.mju_rotVecQuat(inner, size * [0, -1, end], quat)
            # Its outer edge, whichever side the box has turned there.
            outer[end] = pos + max(corner, inner, key=lambda x: float(x[:2] @ pos[:2]))
        assert abs(outer[1][2] - container.height) < container.wall
        assert abs(outer[-1][2]) < container.wall
        stretched = np.array([container.length, 1.0])
        # A point on a side of the polygon is 1 from its middle, measured across the side in stretched lengths.
        for end, width in ((1, 1.0), (-1, container.bottom)):
            across = np.linalg.norm(outer[end][:2] / stretched)
            assert across == pytest.approx(width, abs=1.5 * container.wall), name


def test_containers_that_cannot_be_built_are_refused():
    for field, value, message in (
        ("sides", 9, "sides: got 9, expected 3 to 8"),
        ("handles", 3, "handles: got 3, expected 0 to 2"),
    ):
        with pytest.raises(ValueError, match=message):
            containers.to_geoms(dataclasses.replace(CONTAINERS["box"], **{field: value}))


def test_the_thing_hangs_from_the_tip_and_stays_in_the_hand(env, task):
    """Finds the highest visible point at the tip, whatever the shape."""
    state = held_over(env, task, jax.random.key(6))
    for name in ("lighthouse", "letter_a", "car"):
        chosen = dataclasses.replace(task, thing=jnp.int32(list(SHAPES).index(name)))
        model = c_model(env.mj_model, env.model_of(chosen))
        data = mujoco.MjData(model)
        data.qpos[:] = state.qpos
        mujoco.mj_kinematics(model, data)
        seen = env._geom[0][np.asarray(env.colors(chosen)[env._geom[0], 3]) > 0]
        tops = []
        for geom in seen:
            vertical = np.abs(data.geom_xmat[geom].reshape(3, 3)[2])
            size, kind = model.geom_size[geom], mujoco.mjtGeom(model.geom_type[geom]).name
            reach = {
                "mjGEOM_CAPSULE": size[0] + size[1] * vertical[2],
                "mjGEOM_ELLIPSOID": np.linalg.norm(vertical * size),
                "mjGEOM_BOX": vertical @ size,
                "mjGEOM_CYLINDER": size[1] * vertical[2] + size[0] * np.hypot(*vertical[:2]),
            }[kind]
            tops.append(data.geom_xpos[geom, 2] + reach)
        assert max(tops) == pytest.approx(float(env.hand(state.qpos)[0][2]), abs=1e-6)


@pytest.mark.slow
def test_a_film_goes_on_with_the_fall_from_where_the_hand_held_the_thing(env, dropped):
    tasks, states, (fallen, _) = jax.tree.map(lambda x: x[3], dropped)
    frames = jax.jit(Place((72, 80)).film)(tasks, jax.tree.map(lambda x: x[None], states)).astype(int)
    assert len(frames) == 1 + place.FALL_FRAMES
    np.testing.assert_allclose(frames[1], frames[0], atol=1)
    assert (np.abs(frames[-1] - frames[0]).max(axis=-1) > 8).sum() > 5
    # Back from the last position to the point by which it was held, and there again.
    thing, unit = env._geoms_of(tasks)[0]
    point, turn = env._drop.held_at(thing, unit, fallen)
    again = env._drop.start(thing, unit, point, turn.as_matrix()).qpos
    np.testing.assert_allclose(again[:3], fallen.qpos[:3], atol=1e-9)
    assert abs(again[3:] @ fallen.qpos[3:]) == pytest.approx(1, abs=1e-9)


def test_the_task_blind_forget_the_target_alone(env, task):
    blind = jax.vmap(env.task_blind, in_axes=(0, None))(jax.random.split(jax.random.key(7), 600), task)
    share = np.bincount(blind.target, minlength=3) / 600
    assert np.abs(share - 1 / 3).max() < 4 * (2 / 9 / 600) ** 0.5
    np.testing.assert_array_equal(blind.container[5], task.container)


@pytest.mark.slow
def test_the_hand_of_a_state_far_from_all_containers_misses(env, task):
    state = held_over(env, task, jax.random.key(8))
    away = dataclasses.replace(state, mocap_pos=state.mocap_pos.at[task.target].set(FAR))
    states = State(*(x[None] for x in (away.qpos, away.qvel, away.mocap_pos)))
    assert not bool(env.success(task, states))
