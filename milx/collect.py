"""Plans expert demonstrations and writes them, a file for each split.

    python -m milx.collect --env=reach --workdir=demos --config.data.tasks=100

A file holds states, actions and tasks; `milx.pytrees.load` reads it.
"""

import pathlib

from milx import envs, launch, pytrees, validate
from milx.config import Config
from milx.simulation import split_demos


def main(config: Config, workdir: str) -> None:
    """Writes train.npz, validation.npz and test.npz."""
    validate.check(config)
    env = envs.make(config.env_name, config.env.image_shape, config.env.action_cost)
    for split in envs.SPLITS:
        demos = split_demos(env, config, split)
        path = pathlib.Path(workdir) / f"{split}.npz"
        pytrees.save(path, demos)
        print(f"{path}: {demos.num_tasks} tasks x {demos.num_demos}, {float(demos.success.mean()):.1%} succeed")


if __name__ == "__main__":
    launch.define_flags()
    launch.run(main)
