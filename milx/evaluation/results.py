"""Result files: one JSON object for a run or a cell, with the same fields in all experiments."""

from typing import Any

from milx.config import assemble
from milx.config.schema import Config
from milx.evaluation import provenance

_PLACES = ("recorded.path", "train.wandb")
"""Fields that say where data are or metrics go: they make no other variant."""


def compose(
    config: Config, found: dict[str, Any], seconds: dict[str, float], step: int, dataset_hash: str
) -> dict[str, Any]:
    """Composes a result for its JSON file: what was run, what came out, what it took, and where.

    Args:
        config: what was run.
        found: what the evaluation says (`closed_loop.summarize`).
        seconds: wall-clock by part.
        step: meta-updates of the checkpoint that was evaluated.
        dataset_hash: `fingerprint` of the training demonstrations.
    """
    changed = {name: value for name, value in assemble.overrides(config).items() if name not in _PLACES}
    return {
        "env": config.env_name,
        "method": config.method_name,
        "preset": config.preset,
        "variant": ", ".join(f"{name}={value}" for name, value in changed.items()),
        "seed": config.seed,
        **found,
        "wall_clock_s": seconds,
        "steps": step,
        "config": assemble.to_dict(config),
        "dataset_hash": dataset_hash,
        **provenance.origin(),
    }


def intervals(runs: list[dict[str, Any]]) -> list[tuple[float, float]]:
    """Computes the 95% intervals of the success in result files, all of one kind.

    They are over held-out things ("bootstrap95") if every file has them, else over trials ("wilson95").
    """
    kind = "bootstrap95" if all("bootstrap95" in run for run in runs) else "wilson95"
    return [(run[kind][0], run[kind][1]) for run in runs]
