"""What the planner of pushes begins with, and the model in which it rolls candidates out."""

import copy
import pathlib
import sys

import jax
import mujoco
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


def test_the_cheap_model_moves_the_arm_as_the_environment_does():
    """MuJoCo moves the free arm for half a second by either model's settings, to within a thousandth of its way."""
    ends = []
    for env in (planner.make_env(), planner.make_cheap_env()):
        model, cheap = copy.copy(env.mj_model), env.model.opt
        model.opt.timestep, model.opt.iterations, model.opt.ls_iterations = (
            float(cheap.timestep),
            int(cheap.iterations),
            int(cheap.ls_iterations),
        )
        data = mujoco.MjData(model)
        data.qpos[:7] = np.asarray(env.reset(jax.random.key(0), env.sample_task(jax.random.key(0), "train")).qpos)[:7]
        data.qpos[[7, 8, 10, 11]] = 1.0, 1.0, 1.0, -1.0  # objects out of reach
        start = data.qpos[:7].copy()
        data.ctrl[:] = [0.3, 0.2, -0.2, 0.1, 0.2, -0.3, 0.1]
        mujoco.mj_step(model, data, 10 * env.substeps)
        np.testing.assert_allclose(data.time, 0.5, rtol=1e-6)
        ends.append(data.qpos[:7] - start)
    assert model.opt.iterations < env.mj_model.opt.iterations
    assert np.abs(ends[1] - ends[0]).max() < 1e-3 * np.abs(ends[0]).max()
