"""Learning rates of every method on reach, by success on validation tasks: the same few candidates for each.

    python experiments/tune.py        # what is missing, then the table

Test tasks are not looked at.
"""

import pathlib

import cells
from absl import app, flags

from milx import config as config_lib
from milx import provenance
from milx.config import Config, make_config

RATES = (3e-4, 1e-3, 3e-3)

_HERE = pathlib.Path(__file__).parent
_OUT = flags.DEFINE_string("out", str(_HERE / "results" / "tuning"), "Folder of the JSON files.")
_PRESET = flags.DEFINE_string("preset", "fast", "Hyperparameters of all that is not changed.")
_STEPS = flags.DEFINE_integer("steps", 8000, "Meta-updates; the schedule ends with them.")
_ENVS = flags.DEFINE_list("envs", list(cells.METHODS), "Environments.")


def configure(env: str, method: str, rate: float) -> Config:
    """A short run with one validation, at its end."""
    config = make_config(env, method, _PRESET.value)
    config.optimizer.learning_rate = rate
    config.train.steps = config.train.eval_every = _STEPS.value
    return config


def main(_: list[str]) -> None:
    """Runs what is missing and prints a table."""
    folder = pathlib.Path(_OUT.value)
    print(
        "| environment | method | " + " | ".join(f"{rate:g}" for rate in RATES) + " |",
        "|---|---|---|---|---|",
        sep="\n",
    )
    for env in _ENVS.value:
        runner = cells.Cells(folder, make_config(env, preset=_PRESET.value).data.tasks)
        for method in cells.METHODS[env]:
            for rate in RATES:
                name = f"{env}-{method}-{rate:g}"
                config = configure(env, method, rate)
                if not runner.is_done(name, config):
                    trained = runner.train(name, config)
                    row = {
                        "env": env,
                        "method": method,
                        "learning_rate": rate,
                        "validation_success": trained.validation,
                    }
                    row |= {"config": config_lib.to_dict(config), "wall_clock_s": trained.seconds}
                    runner.write(name, row | provenance.describe())
            found = cells.read(folder)
            shown = [f"{found[f'{env}-{method}-{rate:g}']['validation_success']:.1%}" for rate in RATES]
            print(f"| {env} | {method} | {' | '.join(shown)} |", flush=True)


if __name__ == "__main__":
    app.run(main)
