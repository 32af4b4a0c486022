"""The expert on reach: it succeeds, its plans are rollouts, and what it records are its own answers."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import planned
import pytest

import milx
from milx.envs.reach.env import Reach
from milx.trajopt import expert
from milx.trajopt.ilqr import Options

SCENES = 32
NOISE = 0.1
REACHABLE = 0.25
"""The arm is 0.21 m long and a touch is closer than 0.05 m: targets nearer than this are well within reach."""


@pytest.fixture(scope="module")
def env():
    return milx.make("reach", (8, 10))


@pytest.fixture(scope="module")
def demonstrations(env):
    """Plans of all scenes and their demonstrations [SCENES, 2], the first without noise; float32, as data sets are."""

    @jax.jit
    @jax.vmap
    def demonstrate(key):
        task_key, scene_key, noise_key = jax.random.split(key, 3)
        task = env.sample_task(task_key, "train")
        start = env.reset(scene_key, task)
        plan = expert.plan(env, task, start, Options(iterations=10))
        follow = expert.follow(plan)
        states, actions = jax.vmap(lambda noise: expert.demonstrate(env, task, start, follow, noise_key, noise))(
            jnp.array([0.0, NOISE])
        )
        success = jax.vmap(env.success, in_axes=(None, 0))(task, states)
        return start.mocap_pos[task.target, :2], plan, states, actions, success

    keys = jax.random.split(jax.random.key(0), SCENES)
    # What was written down as planned was rounded so; without optimization, plans differ by up to 0.01.
    program = demonstrate.lower(keys).compile({"xla_backend_optimization_level": 1})
    return jax.device_get(program(keys))


def test_without_noise_the_expert_reaches_every_target_within_reach(demonstrations):
    target, _, _, _, success = demonstrations
    within_reach = np.linalg.norm(target, axis=-1) < REACHABLE
    assert within_reach.sum() > 0.8 * SCENES
    assert success[within_reach, 0].mean() >= 0.97


def test_what_is_planned_is_what_its_version_says(env, demonstrations):
    """Compares tasks, scenes, physics, costs, iLQR and noise: the first scene's demonstrations, at every tenth step."""
    _, _, states, actions, _ = demonstrations
    seen = states.mocap_pos[0, 0, 0], states.qpos[0, :, ::10], actions[0, :, ::10]
    planned.check("reach", [env.version, expert.VERSION], np.concatenate([np.ravel(x) for x in seen]), atol=2e-3)


def test_without_noise_a_demonstration_is_the_plan(demonstrations):
    _, plan, states, actions, _ = demonstrations
    vector = np.concatenate([states.qpos, states.qvel], axis=-1)[:, 0]
    np.testing.assert_allclose(vector, plan.states, rtol=0, atol=1e-3)
    np.testing.assert_allclose(actions[:, 0], plan.actions, rtol=0, atol=1e-3)
    assert np.abs(plan.actions).max() > 0.01, "the expert must act"


def test_recorded_actions_are_the_feedback_on_the_recorded_states(demonstrations):
    _, plan, states, actions, _ = demonstrations
    x = np.concatenate([states.qpos, states.qvel], axis=-1, dtype=float)[:, :, :-1]
    off_plan = x - plan.states[:, None, :-1]
    expected = plan.actions[:, None] + np.einsum("ntij,nktj->nkti", plan.gains, off_plan)
    np.testing.assert_allclose(actions, np.clip(expected, -1, 1), rtol=0, atol=1e-5)
    assert np.abs(expected[:, 1] - plan.actions).max() > 0.05, "the noise must drive the arm off the plan"


def test_the_arm_is_driven_by_the_recorded_action_plus_noise(env, demonstrations):
    """Infers the actions from C MuJoCo's next velocities: they spread as the noise does."""
    _, _, states, actions, _ = demonstrations
    data = mujoco.MjData(env.mj_model)

    def next_velocity(i, t, action):
        data.qpos[:], data.qvel[:], data.ctrl[:] = states.qpos[i, 1, t], states.qvel[i, 1, t], action
        mujoco.mj_step(env.mj_model, data, nstep=env.substeps)
        return data.qvel.copy()

    noise, epsilon = [], 1e-4
    for i, t in np.ndindex(10, env.horizon):
        action = actions[i, 1, t].astype(float)
        if np.abs(action).max() < 0.5:  # far from the limits, where noise is not clipped
            still = next_velocity(i, t, action)
            slope = [(next_velocity(i, t, action + e) - still) / epsilon for e in epsilon * np.eye(2)]
            noise.append(np.linalg.solve(np.transpose(slope), states.qvel[i, 1, t + 1] - still))
    noise = np.ravel(noise)
    assert noise.size > 800
    # Four standard errors of a standard deviation and of a mean; 2% because a step is not quite affine in the action.
    np.testing.assert_allclose(noise.std(), NOISE, rtol=4 / np.sqrt(2 * noise.size) + 0.02)
    np.testing.assert_allclose(noise.mean(), 0, atol=4 * NOISE / np.sqrt(noise.size))


def test_without_a_plan_there_must_be_a_controller(env):
    keys = jax.random.split(jax.random.key(0), 1)
    task = jax.vmap(env.sample_task, in_axes=(0, None))(keys, "train")
    scene = jax.jit(jax.vmap(env.reset))(keys, task)
    with pytest.raises(ValueError, match=r"data\.plan_iterations: got 0, expected at least 1: reach has no controller"):
        expert.perform(env, task, scene, keys, Options(iterations=0), 0.0)


class Turning(Reach):
    """The tactic is the shoulder's motor command. Success: the shoulder ends turned towards the first cube's side."""

    tactics = (0.0, 0.3, -0.3, 0.6)

    def control(self, task, state, tactic):
        return jnp.stack([tactic, 0.0])

    def success(self, task, states):
        x, y, _ = states.mocap_pos[0, 0]
        return (x < 0.1) & (states.qpos[-1, 0] * jnp.sign(y) > 0.01)


@pytest.mark.slow
def test_the_controller_gets_the_first_tactic_that_succeeds_in_rehearsal():
    env, keys = Turning((8, 10)), jax.random.split(jax.random.key(3), 24)
    tasks = jax.vmap(env.sample_task, in_axes=(0, None))(keys, "train")
    scenes = jax.vmap(env.reset)(keys, tasks)
    x, y, _ = np.moveaxis(scenes.mocap_pos[:, 0], -1, 0)
    expected = np.where(x < 0.1, np.where(y > 0, 0.3, -0.3), 0.0)
    assert set(np.unique(expected)) == {-0.3, 0.0, 0.3}
    controller = Options(iterations=0)
    np.testing.assert_array_equal(expert.choose_tactics(env, controller, tasks, scenes, 7), expected)
    assert expert.choose_tactics(env, Options(iterations=1), tasks, scenes, 7) is None
    _, action = expert.perform(env, tasks, scenes, keys, controller, NOISE)
    np.testing.assert_allclose(action[..., 0], np.broadcast_to(expected[:, None], action.shape[:2]), rtol=1e-6)
