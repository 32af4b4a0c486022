"""Films demonstrations: two of each of three training tasks, side by side.

    python experiments/planning/film.py --env=grasp --out=docs/grasp.gif

They are those of a run of the preset, from the cache where they are, and planned where they are not. Tasks of which a
demonstration fails are left out.
"""

import pathlib

import jax
import numpy as np
from absl import app, flags

import milx
from milx import envs
from milx.config.assemble import make_config
from milx.evaluation import closed_loop, plots
from milx.training.simulated import demos_of_split, large

TASKS = 3


def main(_: list[str]) -> None:
    """Writes the film."""
    milx.configure()
    config = make_config(_ENV.value, preset=_PRESET.value)
    env = envs.of_config(config)
    demos = demos_of_split(env, config, "train")
    twice = np.flatnonzero(np.asarray(demos.success).all(axis=1))[:TASKS]
    task, states = jax.tree.map(lambda x: x[twice], (demos.task, demos.states))
    camera = large(_ENV.value, env)
    left, right = (
        np.asarray(closed_loop.film(camera, task, jax.tree.map(lambda x, n=n: x[:, n], states))) for n in range(2)
    )
    plots.side_by_side(left, right, pathlib.Path(_OUT.value))


if __name__ == "__main__":
    _ENV = flags.DEFINE_enum("env", "grasp", list(envs.ENVS), "Which environment.")
    _PRESET = flags.DEFINE_string("preset", "fast", "Whose demonstrations.")
    _OUT = flags.DEFINE_string("out", "demonstrations.gif", "The film.")
    app.run(main)
