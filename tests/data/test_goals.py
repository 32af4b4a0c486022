"""Where a demonstration leads, worked out by hand."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from milx import envs
from milx.config.assemble import make_config
from milx.data.goals import goals, with_goals
from milx.data.simulated import render_demo
from milx.types import Demo, Spec

#                  x    y    height
STATE = np.array(
    [[0.0, 4.0, 0.03], [1.0, 5.0, 0.20], [2.0, 6.0, 0.15], [3.0, 7.0, 0.09], [4.0, 8.0, 0.02], [5.0, 9.0, 0.21]]
)


def test_without_a_height_or_a_step_the_goal_is_the_end():
    np.testing.assert_array_equal(goals(STATE, (0, 1)), np.tile([5.0, 9.0], (6, 1)))


def test_with_a_step_it_is_where_the_robot_is_then_until_it_is_there():
    np.testing.assert_array_equal(goals(STATE, (0, 1), step=2), [[2.0, 6.0]] * 2 + [[np.nan, np.nan]] * 4)
    np.testing.assert_array_equal(goals(STATE, (0, 1), 2, 2), goals(STATE, (0, 1), step=2))
    short = goals(STATE, (0, 1), step=20)
    np.testing.assert_array_equal(short, [[5.0, 9.0]] * 5 + [[np.nan, np.nan]], "a demonstration may be shorter")


def test_with_a_height_it_is_where_the_hand_comes_down_until_it_has():
    """Starts low and rises. The middle of its heights is 0.11: the hand is down from the fourth step on."""
    expected = [[7.0, 3.0]] * 3 + [[np.nan, np.nan]] * 3
    np.testing.assert_array_equal(goals(STATE, (1, 0), 2), expected)


def test_goals_are_added_to_one_demonstration_or_to_several():
    demo = Demo(state=STATE)
    np.testing.assert_array_equal(with_goals(demo, (0, 1), height=2).goal, goals(STATE, (0, 1), 2))
    several = with_goals(Demo(state=np.stack([STATE, STATE[::-1]])), (0, 1))
    np.testing.assert_array_equal(several.goal[:, 0], [[5.0, 9.0], [0.0, 4.0]])
    np.testing.assert_array_equal(with_goals(demo, (0, 1), step=2).goal, goals(STATE, (0, 1), step=2))
    assert with_goals(demo, ()).goal is None
    assert with_goals(Demo(action=STATE), (0, 1)).goal is None


def test_a_configuration_says_when_the_robot_is_at_its_goal(monkeypatch):
    """Moves the arm of a run's environment evenly, and labels what it shows as a policy of that run does."""
    config = make_config("reach_state", preset="cpu")
    assert envs.of_config(config).spec.goal_step is None
    with monkeypatch.context() as patch:
        patch.setattr(envs.find("reach_state"), "goal_step", 7)
        assert envs.of_config(config).spec.goal_step == 7, "the environment's own"
    config.env.goal_step = 2
    env, key = envs.of_config(config), jax.random.key(0)
    task = env.sample_task(key, "train")
    start = env.reset(key, task)
    moved = [dataclasses.replace(start, qpos=start.qpos + 0.1 * t) for t in range(6)]
    states = jax.tree.map(lambda *each: jnp.stack(each), *moved)
    demo = render_demo(env, task, states, jnp.zeros((5, env.action_size)))
    place = demo.state[:, jnp.array(env.goal_indices)]
    assert np.abs(place[1] - place[2]).max() > 0.01
    np.testing.assert_allclose(demo.goal, np.where(np.arange(5)[:, None] < 2, place[2], np.nan), atol=1e-7)
    spec = Spec.from_dict(env.spec.to_dict())
    same = with_goals(demo, spec.goal_indices, **spec.goal_rule)
    np.testing.assert_array_equal(same.goal, demo.goal)
