"""The controller of push, with which experts that learn are compared, and how controllers rehearse."""

import functools
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "experiments" / "paper"))
from push_controller import CONTROLLER, TACTICS, Controlled, control

import milx
from milx.config.schema import DataConfig
from milx.data import experts
from milx.data.goals import goals
from milx.envs.push.env import NUM_JOINTS, Push
from milx.envs.reach.env import Reach


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def env(float64):
    return Push((48, 48))


@pytest.fixture(scope="module")
def shown(env):
    """Samples tasks, and demonstrations of them by the controller with noise on its actions."""
    tasks = jax.vmap(env.sample_task, in_axes=(0, None))(jax.random.split(jax.random.key(8), 32), "train")
    scenes, keys = scenes_of(env, tasks)
    return tasks, *CONTROLLER.perform(env, tasks, scenes, keys, 0.1)


def scenes_of(env, tasks):
    """Resets each task to a scene, and makes a key for its noise."""
    keys = jax.random.split(jax.random.key(9), len(tasks.target))
    return jax.jit(jax.vmap(env.reset))(keys, tasks), keys


def test_the_controller_pushes_most_objects_to_the_goal_in_spite_of_noise(env, shown):
    tasks, states, _ = shown
    assert jax.jit(jax.vmap(env.success))(tasks, states).mean() > 0.9


@pytest.mark.slow
def test_a_tactic_is_how_far_to_the_side_of_the_objects_center_the_hand_meets_it(env, shown):
    """Measures to the left of the hand's view of the goal. Of 32 means under noise, 4 mm are three deviations."""
    tasks, _, _ = shown
    scenes, keys = scenes_of(env, tasks)
    rows, met = np.arange(len(keys)), []
    for tactic in (0.02, -0.02):
        states, _ = Controlled(control, (tactic,)).perform(env, tasks, scenes, keys, 0.1)
        objects = np.asarray(jax.vmap(jax.vmap(env.objects))(states))[rows, :, tasks.target]
        moved = np.argmax(np.linalg.norm(np.diff(objects, axis=1), axis=-1) > 1e-4, axis=1)
        tip = np.asarray(jax.vmap(jax.vmap(env.robot_state))(states))[rows, moved, 14:16]
        place = objects[rows, moved, :2]
        ahead = -place / np.linalg.norm(place, axis=-1, keepdims=True)
        met.append(np.sum(np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1) * (tip - place), axis=-1))
    np.testing.assert_allclose(np.mean(met, axis=1), (0.02, -0.02), atol=0.004)


@pytest.mark.slow
def test_demonstrations_record_the_controllers_answers_before_the_noise(env, shown):
    tasks, states, action = shown
    answer = functools.partial(control, env)
    answers = jax.jit(jax.vmap(jax.vmap(jax.vmap(answer, (None, None, 0)), (None, 0, None)), (0, 0, None)))
    few, before = jax.tree.map(lambda x: x[:8], tasks), jax.tree.map(lambda x: x[:8, :-1], states)
    off = np.abs(answers(few, before, jnp.array(TACTICS)) - action[:8, :, None]).max(axis=(1, 3))
    assert off.min(axis=1).max() < 1e-9, "one and the same tactic all the time"
    scenes, keys = scenes_of(env, tasks)
    quiet, quiet_action = CONTROLLER.perform(env, tasks, scenes, keys, 0.0)
    np.testing.assert_allclose(action[:, 0], quiet_action[:, 0], atol=1e-9)
    off = np.linalg.norm(quiet.qvel[:, 1, :NUM_JOINTS] - states.qvel[:, 1, :NUM_JOINTS], axis=-1)
    assert off.min() > 1e-4, "noise moves the arm"


def test_the_goal_of_a_demonstration_lies_behind_its_target_until_it_is_pushed(env, shown):
    """Compares what the goal head is to see: a place near the target, farther from the disc than the target is."""
    tasks, states, _ = shown
    robot = jax.jit(jax.vmap(jax.vmap(env.robot_state)))(states)
    goal = jax.vmap(lambda state: goals(state, env.goal_indices, env.height_index))(robot)[:, 0]
    place = jax.vmap(env.objects)(jax.tree.map(lambda x: x[:, 0], states))[..., :2]
    rows = np.arange(len(goal))
    target, other = place[rows, tasks.target], place[rows, 1 - tasks.target]
    # A hand that starts low first goes up, past the place: a few goals are farther away.
    assert np.quantile(np.linalg.norm(goal - target, axis=-1), 0.9) < 0.12
    assert (np.linalg.norm(goal, axis=-1) > np.linalg.norm(target, axis=-1)).mean() > 0.9
    assert (np.linalg.norm(goal - target, axis=-1) < np.linalg.norm(goal - other, axis=-1)).mean() > 0.9


def test_it_is_an_expert_by_name_that_knows_push_only(env):
    config = DataConfig(expert="controller", plan_iterations=0, noise=0.1)
    assert experts.expert_of(env, config) is CONTROLLER
    assert experts.description(env, config) == [0.1, "controller", 0.0, 0.02, -0.02]
    expected = "data.expert: got 'controller', expected another one with place: it knows push only"
    with pytest.raises(ValueError, match=expected):
        experts.description(milx.make("place", (8, 10)), config)


class Turning(Reach):
    """Success: the shoulder ends turned towards the first cube's side, if that is near."""

    def success(self, task, states):
        x, y, _ = states.mocap_pos[0, 0]
        return (x < 0.1) & (states.qpos[-1, 0] * jnp.sign(y) > 0.01)


def turn(env, task, state, tactic):
    return jnp.stack([tactic, 0.0])


@pytest.mark.slow
def test_the_controller_acts_by_the_first_tactic_that_succeeds_in_rehearsal():
    env, keys = Turning((8, 10)), jax.random.split(jax.random.key(3), 24)
    tasks = jax.vmap(env.sample_task, in_axes=(0, None))(keys, "train")
    scenes = jax.vmap(env.reset)(keys, tasks)
    x, y, _ = np.moveaxis(scenes.mocap_pos[:, 0], -1, 0)
    expected = np.where(x < 0.1, np.where(y > 0, 0.3, -0.3), 0.0)
    assert set(np.unique(expected)) == {-0.3, 0.0, 0.3}
    controller = Controlled(turn, (0.0, 0.3, -0.3, 0.6))
    np.testing.assert_array_equal(controller.choose(env, tasks, scenes), expected)
    _, action = controller.perform(env, tasks, scenes, keys, 0.05)
    np.testing.assert_allclose(action[..., 0], np.broadcast_to(expected[:, None], action.shape[:2]), rtol=1e-6)
