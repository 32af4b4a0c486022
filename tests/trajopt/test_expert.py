"""The expert on reach: it succeeds, its plans are rollouts, and what it records are its own answers."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import planned
import pytest

import milx
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
