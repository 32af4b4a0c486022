"""Result files: one JSON object for a run, the same for all experiments."""

import json
import pathlib
from typing import Any

from milx import config as config_lib
from milx import provenance
from milx.config import Config
from milx.envs.base import Env


def describe(
    config: Config,
    env: Env,
    summary: dict[str, Any],
    floors: dict[str, float],
    seconds: dict[str, float],
    step: int,
    dataset_hash: str,
) -> dict[str, Any]:
    """A result as its JSON file holds it: what was run, what came out, what it took, and where.

    Args:
        config: what was run.
        env: its environment.
        summary: trials, success and wilson95.
        floors: success rates of the baselines in the same trials.
        seconds: wall-clock by part.
        step: meta-updates of the checkpoint that was evaluated.
        dataset_hash: `fingerprint` of the training demonstrations.
    """
    return {
        "env": config.env_name,
        "method": config.method_name,
        "preset": config.preset,
        "variant": ", ".join(f"{name}={value}" for name, value in config_lib.overrides(config).items()),
        "seed": config.seed,
        "num_tasks_train": config.data.tasks,
        "num_demos_train": config.data.tasks * config.data.demos_per_task,
        "shots": config.evaluation.shots,
        "given": config.mil.given if env.vision else config.mil.given.removeprefix("video+"),
        **summary,
        "criterion": env.criterion,
        "baselines": floors,
        "wall_clock_s": seconds,
        "steps": step,
        "config": config_lib.to_dict(config),
        "dataset_hash": dataset_hash,
        **provenance.describe(),
    }


def write_json(path: pathlib.Path, values: dict[str, Any]) -> None:
    """Writes a file as a whole: a process that is killed leaves the old one or the new one."""
    partial = path.with_suffix(".partial")
    partial.write_text(json.dumps(values, indent=1) + "\n")
    partial.replace(path)
