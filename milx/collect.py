"""Plans expert demonstrations and writes them to one file for each split.

    python -m milx.collect --env=reach --workdir=demos --config.data.tasks=100

Each file holds the tasks, the states, the actions and whether each demonstration succeeds;
`milx.core.pytrees.read(path, like)` reads it, with `like` from `milx.data.simulated.shapes`.
"""

import pathlib

from milx import envs
from milx.config.check import check_config
from milx.config.schema import Config
from milx.core import pytrees
from milx.training import command_line
from milx.types import SPLITS


def main(config: Config, workdir: str) -> None:
    """Writes train.npz, validation.npz and test.npz."""
    check_config(config)
    env = envs.of_config(config)
    from milx.training.simulated import demos_of_split  # needs MuJoCo, of which `make` says if it is not there

    for split in SPLITS:
        demos = demos_of_split(env, config, split)
        path = pathlib.Path(workdir) / f"{split}.npz"
        pytrees.write(path, demos)
        print(f"{path}: {demos.num_tasks} tasks x {demos.num_demos}, {float(demos.success.mean()):.1%} succeed")


if __name__ == "__main__":
    command_line.define_flags()
    command_line.run(main)
