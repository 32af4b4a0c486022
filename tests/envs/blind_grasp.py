"""A hand that grasps blindly: it goes where the thing lies and to the mat, whatever it touches."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from milx.envs.grasp import env as grasp

CLOSING, LIFTED = 16 + 8, 16 + 8 + 5 + 10
"""The time steps at which the fingers of `wanted` begin to close, and at which the thing has been lifted."""


def first(tree, number=0):
    """Takes one of a batch."""
    return jax.tree.map(lambda x: x[number], tree)


def c_model(env, task):
    """Compiles MuJoCo's own model of a task."""
    model, ours = copy.copy(env.mj_model), jax.jit(env.model_of)(task)
    for name in ("geom_pos", "geom_quat", "geom_size"):
        getattr(model, name)[:] = getattr(ours, name)
    model.geom_rbound[model.geom_rbound > 0] = 1.0  # a bound for all sizes
    model.geom_sameframe[:] = 0  # else MuJoCo takes the body's frame for those of geoms that were compiled at 0
    return model


def wanted(task, state):
    """Lists where the hand goes, and how it closes, in each step of a blind grasp: down, up, over the mat, down."""
    thing, mat = state.qpos[5:8], state.mocap_pos[task.target]
    low, way = thing.at[2].set(0.006), mat.at[2].set(0.1)
    phases = [(thing.at[2].set(0.06), 16, -1), (low, 8, -1), (low, 5, 1), (thing.at[2].set(0.1), 10, 1)]
    phases += [(way, 25, 1), (mat.at[2].set(0.05), 8, 1), (mat.at[2].set(0.05), 8, -1)]
    return jnp.stack([jnp.append(place, grip) for place, steps, grip in phases for _ in range(steps)])


def act(state, goal):
    """Moves towards a place."""
    speed = 8 * (goal[:3] - state.qpos[:3])
    return jnp.clip(jnp.append(speed / grasp.MAX_SPEED, goal[3]), -1, 1)


def in_c(env, task, start):
    """Grasps blindly in C MuJoCo; returns qpos [80, nq]."""
    model = c_model(env, task)
    data = mujoco.MjData(model)
    data.qpos[:], data.mocap_pos[:] = start.qpos, start.mocap_pos
    positions = []
    for goal in wanted(task, start):
        data.ctrl[:] = act(dataclasses.replace(start, qpos=jnp.asarray(data.qpos)), goal)
        mujoco.mj_step(model, data, nstep=env.substeps)
        positions.append(data.qpos.copy())
    return np.array(positions)
