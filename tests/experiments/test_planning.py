"""What the planner of pushes begins with, and the model in which it rolls candidates out."""

import pathlib
import sys

import numpy as np
import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "experiments" / "planning"))
import planner


def test_nearest_are_those_of_a_loop():
    rng = np.random.default_rng(0)
    features, others = rng.normal(size=(7, 3)), rng.normal(size=(20, 3))
    for row, found in zip(features, planner.nearest(features, others, 5), strict=True):
        distances = [np.linalg.norm(row - other) for other in others]
        assert set(found) == set(np.argsort(distances)[:5])
    with pytest.raises(ValueError, match="count: got 21, expected at most 20, the plans that there are"):
        planner.nearest(features, others, 21)


def test_a_time_step_of_the_cheap_model_is_as_long_and_has_less_physics():
    env, cheap = planner.make_env(), planner.make_cheap_env()
    seconds, cheap_seconds = (float(e.model.opt.timestep) * e.substeps for e in (env, cheap))
    np.testing.assert_allclose(cheap_seconds, seconds, rtol=1e-6)
    work = [e.substeps * e.model.opt.iterations * e.model.opt.ls_iterations for e in (env, cheap)]
    assert work == [5 * 6 * 8, 3 * 2 * 4]
