"""The Gymnasium adapter: its checker's rules, and the same physics and pixels as the environment itself."""

import warnings

import gymnasium
import jax
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from milx import envs, gym
from milx.config.schema import DataConfig
from milx.gym import GymEnv
from milx.trajopt.expert import Planned


@pytest.fixture(scope="module")
def gym_env():
    return GymEnv("reach", split="test", image_shape=(16, 20), render_mode="rgb_array")


@pytest.mark.slow
def test_the_checker_of_gymnasium_is_content(gym_env):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings(
            "ignore", message=".*not have a `spec`|.*minimum value is -infinity|.*maximum value is inf"
        )
        warnings.filterwarnings("ignore", message=".*not able to test alternative render modes")
        check_env(gym_env, skip_render_check=False)


def test_gymnasium_makes_them_itself():
    """Makes a registered environment by its name; its episode is that of the class."""
    made = gymnasium.make("milx.gym:milx/ReachState-v0", split="test")
    alone = GymEnv("reach_state", split="test")
    for env in (made, alone):
        env.action_space.seed(0)
    first, second = (env.reset(seed=3)[0]["state"] for env in (made, alone))
    np.testing.assert_array_equal(first, second)
    for _ in range(3):
        (seen, reward, *_), (expected, theirs, *_) = (env.step(env.action_space.sample()) for env in (made, alone))
        np.testing.assert_array_equal(seen["state"], expected["state"])
        assert reward == theirs
    with warnings.catch_warnings(action="ignore"):
        check_env(made.unwrapped)
    assert set(gym.IDS) == {"reach", "reach_state", "push", "place", "grasp"} <= set(envs.ENVS)


@pytest.mark.slow
def test_the_checker_of_gymnasium_is_content_with_push():
    """Compiles the dynamics and the renderer of a whole world."""
    made = gymnasium.make("milx/Push-v0", split="test", image_shape=(16, 20))
    with warnings.catch_warnings(action="ignore"):
        check_env(made.unwrapped)


def test_an_episode_is_the_environments(gym_env):
    """Compares states, images, rewards and success, step by step."""
    env, rng = gym_env.env, np.random.default_rng(0)
    observation, _ = gym_env.reset(seed=4)
    task, states = gym_env._task, [gym_env._states[0]]
    step, observe = jax.jit(env.step), jax.jit(env.observe)
    for t in range(env.horizon):
        action = rng.uniform(-1, 1, 2).astype(np.float32)
        expected_cost = 0.5 * np.sum(np.square(env.running_residual(task, states[-1], action, t)))
        observation, reward, terminated, truncated, info = gym_env.step(action)
        states.append(step(task, states[-1], action))
        seen = observe(task, states[-1])
        np.testing.assert_allclose(observation["state"], seen.state, atol=1e-6)
        np.testing.assert_array_equal(observation["image"], seen.image)
        assert reward == pytest.approx(-expected_cost, rel=1e-5)
        assert not terminated
        assert truncated == (t == env.horizon - 1)
    whole = jax.tree.map(lambda *x: np.stack(x), *states)
    assert info["is_success"] == bool(env.success(task, whole))
    np.testing.assert_array_equal(gym_env.render(), observation["image"])


def test_seeds_repeat_and_the_task_can_stay(gym_env):
    first = gym_env.reset(seed=1)[0], gym_env._task
    again = gym_env.reset(seed=1)[0], gym_env._task
    jax.tree.map(np.testing.assert_array_equal, first, again)
    _, stays = gym_env.reset(options={"same_task": True})[0], gym_env._task
    jax.tree.map(np.testing.assert_array_equal, again[1], stays)
    other = gym_env.reset()[0], gym_env._task
    assert np.abs(np.asarray(other[1].object_color) - np.asarray(stays.object_color)).max() > 0.01


def test_a_demonstration_is_of_the_same_task_in_another_scene(gym_env, monkeypatch):
    """Replaces the planner, which has tests of its own, by one that stands still and records what it was asked."""
    asked = {}

    def stand_still(self, env, task, scene, key, noise):
        asked.update(task=task, scene=scene, iterations=self.options.iterations, noise=noise)
        return jax.tree.map(lambda x: np.repeat(x[:, None], env.horizon + 1, axis=1), scene), np.zeros((1, 50, 2))

    monkeypatch.setattr(Planned, "perform", stand_still)
    gym_env.reset(seed=2)
    demo = gym_env.demonstrate(DataConfig(plan_iterations=8, noise=0.3))
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[0], b), asked["task"], gym_env._task)
    assert (asked["iterations"], asked["noise"]) == (8, 0.3)
    mine = gym_env._states[0]
    assert np.abs(asked["scene"].mocap_pos[0] - mine.mocap_pos).max() > 0.03
    there = jax.tree.map(lambda x: x[0], asked["scene"])
    seen = jax.jit(gym_env.env.observe)(gym_env._task, there)
    np.testing.assert_array_equal(demo.image, np.broadcast_to(seen.image, demo.image.shape))
    np.testing.assert_allclose(demo.state, np.broadcast_to(seen.state, demo.state.shape), atol=1e-6)


def test_names_that_do_not_exist_are_refused():
    for arguments, message in (
        ({"name": "raech"}, "env: got 'raech', expected one of reach"),
        ({"split": "dev"}, "split: got 'dev', expected one of train, validation, test"),
        ({"render_mode": "human"}, "render_mode: got 'human', expected None or 'rgb_array'"),
    ):
        with pytest.raises(ValueError, match=message):
            GymEnv(**arguments)
    assert "reach" in envs.ENVS
