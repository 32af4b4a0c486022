"""Learning rate and schedule of every method, by success on validation tasks: the same candidates for each.

    python experiments/paper/tune.py        # what is missing, then the table

Test tasks are not looked at.
"""

from typing import Any

import cells
import options
from absl import app, flags

import milx
from milx.config import assemble
from milx.config.assemble import make_config
from milx.config.schema import Config
from milx.evaluation import provenance

CANDIDATES = {
    "1e-4": (1e-4, True),
    "3e-4": (3e-4, True),
    "1e-3": (1e-3, True),
    "3e-3": (3e-3, True),
    "1e-3, constant": (1e-3, False),
}
"""Learning rate, and whether it decays to zero along a cosine."""

STEPS = {"reach": 8_000, "reach_state": 5_000, "push": 10_000, "place": 10_000, "grasp": 10_000}
"""Meta-updates of every run, fewer than in figure 3."""

flags.adopt_module_key_flags(options)
_ENVS = flags.DEFINE_list("envs", list(cells.METHODS), "Environments.")
_METHODS = flags.DEFINE_list("methods", None, "Methods; default all.")


def configure(env: str, method: str, candidate: str) -> Config:
    """Configures a short run, validated at its end only; the schedule ends with it."""
    config = cells.configure(env, method, options.PRESET.value, seed=0, steps=options.STEPS.value or STEPS[env])
    config.optimizer.learning_rate, config.optimizer.cosine = CANDIDATES[candidate]
    config.train.eval_every = config.train.steps
    config.train.redraw = env in ("push", "place", "grasp")  # as in their tables
    return config


def main(_: list[str]) -> None:
    """Runs what is missing and prints a table."""
    milx.configure()
    folder = options.folder("tuning")
    print(f"| environment | method | {' | '.join(CANDIDATES)} |", "|---" * (2 + len(CANDIDATES)) + "|", sep="\n")
    for env in _ENVS.value:
        runner = cells.Cells(folder, make_config(env, preset=options.PRESET.value).data.tasks)
        for method in cells.methods_of(env, _METHODS.value):
            names = {candidate: f"{env}-{method}-{candidate.replace(', ', '-')}" for candidate in CANDIDATES}
            for candidate, name in names.items():
                config = configure(env, method, candidate)
                if not options.SHOW.value and not runner.is_done(name, config):
                    trained = runner.train(name, config)
                    row: dict[str, Any] = {"env": env, "method": method, "candidate": candidate}
                    row |= {"validation_success": trained.validation, "wall_clock_s": trained.seconds}
                    runner.write(name, row | {"config": assemble.to_dict(config)} | provenance.origin())
                    runner.forget()
            found = cells.read(folder)
            shown = [f"{found[name]['validation_success']:.1%}" if name in found else "" for name in names.values()]
            print(f"| {env} | {method} | {' | '.join(shown)} |", flush=True)


if __name__ == "__main__":
    app.run(main)
