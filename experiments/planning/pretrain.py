"""Learns an expert by policy optimization, and puts it where experts ship (`data.expert=pretrained`).

    python experiments/planning/pretrain.py              # push, on a GPU
    python experiments/planning/pretrain.py --env=place --out=actors

It is the expert of a run with `data.expert=ppo`, the noise of the preset `fast` and as many iterations as in
`demonstrate.py`, from the user's cache if it is there already.
"""

import dataclasses
import pathlib

from absl import app, flags

import milx
from milx import envs
from milx.config.assemble import make_config
from milx.core import pytrees
from milx.data import experts
from milx.trajopt.expert import Learned


def main(_: list[str]) -> None:
    """Learns, and writes the file."""
    milx.configure()
    config = make_config(_ENV.value, preset="fast").data
    config = dataclasses.replace(config, expert="ppo", plan_iterations=experts.LEARNED.iterations)
    expert = experts.expert_of(envs.make(_ENV.value, (16, 16)), config)
    assert isinstance(expert, Learned)
    folder = pathlib.Path(_OUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    pytrees.write(folder / f"{_ENV.value}.npz", expert.actor)


if __name__ == "__main__":
    _ENV = flags.DEFINE_enum("env", "push", list(envs.ENVS), "Which environment.")
    _OUT = flags.DEFINE_string("out", str(experts.PRETRAINED), "Folder of the files.")
    app.run(main)
