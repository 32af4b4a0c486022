"""Plans demonstrations, meta-trains, evaluates: from nothing to a one-shot policy.

Run it again with the same flags and it continues where it stopped.

    python -m milx.train --env=reach
    python -m milx.train --env=reach --preset=paper --seed=1 --config.train.meta_batch=25
"""

from milx import launch, runs
from milx.config import Config


def main(config: Config, workdir: str) -> None:
    """Trains and evaluates."""
    run = runs.make(config, workdir)
    run.train()
    run.report(run.evaluate())


if __name__ == "__main__":
    launch.define_flags()
    launch.run(main)
