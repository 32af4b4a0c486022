"""Plans or reads demonstrations, meta-trains a policy on them, and evaluates it on held-out tasks.

A run that is started again with the same flags continues where it stopped; with a larger train.steps it is extended.

    python -m milx.train --env=reach
    python -m milx.train --env=reach --preset=paper --seed=1 --config.train.meta_batch=25
"""

from milx.config.schema import Config
from milx.training import command_line
from milx.training.factory import make_run


def main(config: Config, workdir: str) -> None:
    """Meta-trains the policy and evaluates it."""
    run = make_run(config, workdir)
    run.train()
    run.report(run.evaluate())
    run.suggest()


if __name__ == "__main__":
    command_line.define_flags()
    command_line.run(main)
