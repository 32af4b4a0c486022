"""Plans demonstrations, meta-trains, evaluates: from nothing to a one-shot policy.

Run it again with the same flags and it continues where it stopped.

    python -m milx.train --env=reach
    python -m milx.train --env=reach --preset=paper --seed=1 --config.train.meta_batch=25
"""

from milx.config.schema import Config
from milx.training import command_line
from milx.training.factory import make_run


def main(config: Config, workdir: str) -> None:
    """Trains and evaluates."""
    run = make_run(config, workdir)
    run.train()
    run.report(run.evaluate())


if __name__ == "__main__":
    command_line.define_flags()
    command_line.run(main)
