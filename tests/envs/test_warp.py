"""Physics by MuJoCo Warp against C MuJoCo and MJX; needs the extra warp (`pytest -m warp`)."""

import copy
import dataclasses
import functools
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from blind_grasp import CLOSING, LIFTED, act, first, in_c, wanted

from milx import envs
from milx.config.assemble import make_config
from milx.config.check import check_config
from milx.core.mjx import mjx
from milx.data import experts
from milx.envs.grasp.env import Grasp
from milx.envs.push.env import NUM_JOINTS, Push
from milx.envs.warp import WarpPhysics
from milx.trajopt import expert, receding
from milx.trajopt.ilqr import Options

SCENES = 24


@pytest.fixture(scope="module")
def env():
    return Grasp((18, 20)).by_warp()


@pytest.fixture(scope="module")
def tasks(env):
    return jax.vmap(env.sample_task, in_axes=(0, None))(jax.random.split(jax.random.key(0), SCENES), "train")


@pytest.fixture(scope="module")
def starts(env, tasks):
    return jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(1), SCENES), tasks)


def follow(env, task, start, goals):
    """Moves the hand to goals [T, 4]."""

    def step(state, goal):
        state = env.step(task, state, act(state, goal))
        return state, state

    return jax.lax.scan(step, start, goals)[1]


def replay(env, task, start, actions, method="step"):
    """Applies actions [T, A]."""

    def step(state, action):
        state = getattr(env, method)(task, state, action)
        return state, state

    return jax.lax.scan(step, start, actions)[1]


@pytest.fixture(scope="module")
def shown(env, tasks, starts):
    """Grasps blindly in every scene."""
    goals = jax.vmap(wanted)(tasks, starts)
    return jax.jit(jax.vmap(lambda *scene: follow(env, *scene)))(tasks, starts, goals)


@pytest.fixture(scope="module")
def expected(env, tasks, starts):
    """Grasps blindly in C MuJoCo: qpos [N, 80, nq]."""
    return np.stack([in_c(env, first(tasks, n), first(starts, n)) for n in range(SCENES)])


@pytest.mark.warp
def test_the_hand_and_what_lies_on_the_table_move_as_in_mujoco(shown, expected):
    """Compares the time until the fingers close; how a grasp goes on depends on the last digit.

    In the first steps they may be a few millimeters apart: a thing that has just been laid on the table touches it or
    not by the last digit.
    """
    np.testing.assert_allclose(shown.qpos[:, :3], expected[:, :3], atol=5e-3)
    np.testing.assert_allclose(shown.qpos[:, 3:CLOSING], expected[:, 3:CLOSING], atol=3e-4)


@pytest.mark.warp
def test_a_grasp_lifts_as_many_things_as_in_mujoco(shown, expected):
    lifted, in_mujoco = shown.qpos[:, LIFTED - 1, 7] > 0.06, expected[:, LIFTED - 1, 7] > 0.06
    assert min(np.mean(lifted), np.mean(in_mujoco)) > 0.8
    assert abs(np.mean(lifted) - np.mean(in_mujoco)) < 0.15


@pytest.mark.warp
def test_steps_do_not_depend_on_how_worlds_are_batched(env, tasks, starts, shown):
    """Steps grasped things: all at once, alone, and each with several actions, which share a task's model."""
    states = jax.tree.map(lambda x: x[:, CLOSING + 6], shown)
    actions = jnp.linspace(-0.5, 0.5, 3)[:, None] * jnp.ones(env.action_size)
    several = jax.vmap(jax.vmap(env.step, in_axes=(None, None, 0)), in_axes=(0, 0, None))
    grouped = jax.jit(several)(tasks, states, actions)
    swapped = jax.vmap(jax.vmap(env.step, in_axes=(0, 0, None)), in_axes=(None, None, 0))
    np.testing.assert_allclose(
        grouped.qpos, jax.jit(swapped)(tasks, states, actions).qpos.swapaxes(0, 1), rtol=0, atol=1e-6
    )
    for n, a in ((0, 0), (7, 1), (23, 2)):
        alone = env.step(first(tasks, n), first(states, n), actions[a])
        np.testing.assert_allclose(grouped.qpos[n, a], alone.qpos, rtol=0, atol=1e-6)


@pytest.mark.warp
def test_no_contact_is_lost_where_every_world_has_many(env, tasks, starts):
    """Drops things through a table that carries them only if each world's contacts have room."""
    many = 256
    task, start = first(tasks), first(starts)
    speeds = jnp.linspace(-0.1, 0.1, many)
    states = dataclasses.replace(
        jax.tree.map(lambda x: jnp.broadcast_to(x, (many, *x.shape)), start),
        qvel=jnp.zeros((many, env.mj_model.nv)).at[:, 5].set(speeds),
    )
    rest = jax.jit(jax.vmap(lambda state: follow(env, task, state, jnp.tile(jnp.append(start.qpos[:3], -1.0), (8, 1)))))
    np.testing.assert_allclose(rest(states).qpos[:, -1, 7], env.resting(task), atol=2e-3)


@pytest.mark.warp
def test_demonstrations_are_planned_and_executed_by_warp(env, tasks, starts):
    """Executes the recorded actions of demonstrations without noise again."""
    short = copy.copy(env)
    short.horizon, short.ahead = 6, 3
    settings = receding.Settings(knots=2, search=dataclasses.replace(receding.SEARCH, samples=4, elites=2))
    few = jax.tree.map(lambda x: x[:3], (tasks, starts))
    states, actions = receding.demonstrate(short, settings, 0.0, *few, jax.random.split(jax.random.key(2), 3))
    again = jax.jit(jax.vmap(functools.partial(replay, short)))(*few, actions)
    np.testing.assert_allclose(states.qpos[:, 1:], again.qpos, atol=1e-4)
    assert np.abs(again.qpos[:, -1, :3] - starts.qpos[:3, :3]).max() > 0.01, "the hand has moved"


@pytest.mark.warp
def test_ilqr_plans_without_warp_which_has_no_derivatives(env, tasks, starts, monkeypatch):
    monkeypatch.setattr(WarpPhysics, "advance", None)
    plan = functools.partial(expert.plan, env, options=Options(iterations=1))
    assert jax.eval_shape(plan, first(tasks), first(starts)).actions.shape == (env.horizon, env.action_size)
    assert env.differentiable is env.differentiable
    assert env.differentiable.physics == "jax"


@pytest.mark.warp
@pytest.mark.parametrize(("method", "atol"), [("step", 1e-4), ("approximate_step", 2e-4)])
def test_masses_friction_and_cheaper_steps_of_push_are_passed_on(method, atol):
    """Compares with MJX where the hand begins in the target and pushes it away; a heavier one moves otherwise."""
    env = Push((18, 20))
    task = env.sample_task(jax.random.key(0), "train")
    start = env.reset(jax.random.key(1), task)
    tip = env.hand(start.qpos)[:2]
    start = dataclasses.replace(
        start, qpos=start.qpos.at[NUM_JOINTS : NUM_JOINTS + 2].set(tip + jnp.array([0.0, 0.05]))
    )
    actions = jnp.tile(jnp.linspace(-0.6, 0.6, env.action_size), (6, 1))

    def moved(env, task):
        states = jax.jit(lambda task: replay(env, task, start, actions, method))(task)
        return np.asarray(states.qpos[:, NUM_JOINTS:])

    expected, found = moved(env, task), moved(env.by_warp(), task)
    assert np.abs(expected[-1] - start.qpos[NUM_JOINTS:]).max() > 5e-3, "the target has moved"
    np.testing.assert_allclose(found, expected, atol=atol)
    heavier = dataclasses.replace(task, mass=3 * task.mass, damping=3 * task.damping)
    assert np.abs(moved(env.by_warp(), heavier) - found).max() > 10 * atol


@pytest.mark.warp
def test_double_precision_goes_in_and_comes_out(tasks, shown):
    settled = jax.tree.map(lambda x: x[0, 10], shown)
    with jax.enable_x64(True):
        env = Grasp((18, 20))
        scene = jax.tree.map(lambda x: x.astype(float) if x.dtype == jnp.float32 else x, (first(tasks), settled))
        action = jnp.full(env.action_size, 0.2)
        found, expected = env.by_warp().step(*scene, action).qpos, env.step(*scene, action).qpos
        assert found.dtype == expected.dtype == jnp.float64
        np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.warp
def test_data_for_many_worlds_are_what_mjx_makes(env):
    """Compares all arrays; those for contacts are written down as one number."""
    physics = env._warp
    sizes = {"naconmax": 3 * physics._contacts, "njmax": physics._constraints}
    expected = mjx.make_data(env.mj_model, impl="warp", **sizes)
    jax.tree.map(np.testing.assert_array_equal, physics._data(3), expected)


@pytest.mark.warp
def test_demonstrations_by_warp_are_kept_apart():
    config = make_config("grasp", preset="fast")
    by_jax = envs.of_config(config)
    config.env.physics = "warp"
    by_warp = envs.of_config(config)
    assert (by_jax.physics, by_warp.physics) == ("jax", "warp")
    assert experts.digest(by_jax) != experts.digest(by_warp)


@pytest.mark.parametrize("name", ["reach", "place"])
def test_worlds_that_integrate_by_themselves_refuse_warp(name):
    config = make_config(name, preset="cpu")
    config.env.physics = "warp"
    with pytest.raises(ValueError, match=r"env.physics: got 'warp', expected 'jax' for \w+, whose steps are its own"):
        envs.of_config(config)


def test_physics_that_do_not_exist_are_refused():
    config = make_config("grasp", preset="fast")
    config.env.physics = "bullet"
    with pytest.raises(ValueError, match=r"env.physics: got 'bullet', expected one of jax, warp"):
        check_config(config)


def test_what_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(ValueError, match=r"env.physics: got 'warp', expected `pip install 'milx\[warp\]'` first"):
        Grasp((18, 20)).by_warp()
