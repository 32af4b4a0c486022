"""Where a demonstration leads, worked out by hand."""

import numpy as np

from milx.data.goals import goals, with_goals
from milx.types import Demo

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
    np.testing.assert_array_equal(with_goals(demo, (0, 1), 2).goal, goals(STATE, (0, 1), 2))
    several = with_goals(Demo(state=np.stack([STATE, STATE[::-1]])), (0, 1))
    np.testing.assert_array_equal(several.goal[:, 0], [[5.0, 9.0], [0.0, 4.0]])
    np.testing.assert_array_equal(with_goals(demo, (0, 1), step=2).goal, goals(STATE, (0, 1), step=2))
    assert with_goals(demo, ()).goal is None
    assert with_goals(Demo(action=STATE), (0, 1)).goal is None
