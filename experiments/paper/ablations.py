"""What each part of MIL is worth on vision reach: one thing changed at a time, and more shots at test.

    python experiments/paper/ablations.py              # what is missing, then the table

Stopped and started again it goes on with its last checkpoint.
"""

from typing import Any

import cells
import options
from absl import app, flags

import milx
from milx.config import assemble
from milx.config.schema import Config

ABLATIONS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "5 shots at test": {"evaluation.shots": 5},
    "no bias transformation": {"network.bias_transformation": 0},
    "first order": {"method.first_order": True},
    "fixed inner rate": {"method.learn_inner_lr": False},
    "3 inner steps": {"method.inner_steps": 3},
    "5 inner steps": {"method.inner_steps": 5},
    "two heads": {"network.heads": 2},
    "convolutions in float32": {"network.mixed_precision": False},
    "no goal head": {"network.goal_head": False, "method.goal_weight": 0.0},
}

flags.adopt_module_key_flags(options)
_CHANGED = flags.DEFINE_multi_enum("changed", list(ABLATIONS), list(ABLATIONS), "Which of them; default all.")


def configure(changes: dict[str, Any], seed: int) -> Config:
    """Configures a cell of figure 3 with some fields, by dotted name, changed."""
    config = cells.configure("reach", "mil", options.PRESET.value, seed, options.STEPS.value)
    for name, value in changes.items():
        assemble.assign(config, name, value)
    return config


def main(_: list[str]) -> None:
    """Runs what is missing and prints a table."""
    milx.configure()
    folder = options.folder("ablations")
    runner = cells.Cells(folder, configure({}, seed=0).data.tasks)
    for seed in range(options.SEEDS.value):
        for name in () if options.SHOW.value else _CHANGED.value:
            runner.run({f"{name.replace(' ', '-')}-{seed}": configure(ABLATIONS[name], seed)})
    print(markdown(cells.read(folder), _CHANGED.value, options.SEEDS.value))


def markdown(results: dict[str, dict[str, Any]], changed: list[str], seeds: int) -> str:
    """Writes a table of what there is: test success of every seed, and how long the first one's training took."""
    lines = ["| changed | " + " | ".join(f"seed {seed}" for seed in range(seeds)) + " | training |"]
    lines.append("|---|" + "---|" * (seeds + 1))
    for name in changed:
        runs = [results.get(f"{name.replace(' ', '-')}-{seed}") for seed in range(seeds)]
        shown = [_shown(run) if run else "" for run in runs]
        training = next((f"{run['wall_clock_s']['train']:.0f} s" for run in runs if run), "")
        lines.append(f"| {name} | {' | '.join(shown)} | {training} |")
    return "\n".join(lines)


def _shown(run: dict[str, Any]) -> str:
    low, high = run["wilson95"]
    return f"{run['success']:.1%} ({low:.1%} to {high:.1%})"


if __name__ == "__main__":
    app.run(main)
