"""Physics by MuJoCo Warp against C MuJoCo and MJX; needs the extra warp (`pytest -m warp`)."""

import dataclasses
import functools
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from blind_grasp import CLOSING, LIFTED, act, first, in_c, wanted

import milx
from milx import envs
from milx.config.assemble import make_config
from milx.data import experts
from milx.envs.grasp.env import Grasp
from milx.envs.warp import WarpPhysics
from milx.trajopt import expert
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

    In the first steps things come to rest, and the solvers stop after six iterations, in slightly different places.
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
def test_ilqr_plans_without_warp_which_has_no_derivatives(env, tasks, starts, monkeypatch):
    monkeypatch.setattr(WarpPhysics, "advance", None)
    plan = functools.partial(expert.plan, env, options=Options(iterations=1))
    assert jax.eval_shape(plan, first(tasks), first(starts)).actions.shape == (env.horizon, env.action_size)


@pytest.mark.warp
def test_demonstrations_by_warp_are_kept_apart():
    config = make_config("grasp", preset="fast")
    by_jax = envs.of_config(config)
    config.env.physics = "warp"
    by_warp = envs.of_config(config)
    assert (by_jax.physics, by_warp.physics) == ("jax", "warp")
    assert experts.digest(by_jax) != experts.digest(by_warp)


def test_worlds_that_integrate_by_themselves_refuse_warp():
    for name in ("reach", "place"):
        with pytest.raises(ValueError, match=r"physics: got 'warp', expected 'jax' for \w+, which overrides integrate"):
            milx.make(name, (8, 10)).by_warp()


def test_physics_that_do_not_exist_are_refused():
    config = make_config("grasp", preset="fast")
    config.env.physics = "bullet"
    with pytest.raises(ValueError, match=r"env.physics: got 'bullet', expected one of jax, warp"):
        envs.of_config(config)


def test_what_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(ValueError, match=r"physics: got 'warp', expected `pip install 'milx\[warp\]'` first"):
        Grasp((18, 20)).by_warp()
