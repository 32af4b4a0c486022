"""Plots and videos of a run."""

import contextlib
import json
import pathlib
from typing import Any

import imageio.v3 as iio
import numpy as np
from matplotlib.figure import Figure


def read_metrics(path: pathlib.Path) -> list[dict[str, Any]]:
    """The lines of a metrics.jsonl file that are whole: a kill or a full disk may have left half a line."""
    lines = []
    for line in path.read_text().splitlines():
        with contextlib.suppress(ValueError):
            lines.append(json.loads(line))
    return [line for line in lines if isinstance(line, dict) and "step" in line]


def learning_curve(metrics: list[dict[str, Any]], evaluation: dict[str, Any], path: pathlib.Path) -> None:
    """Plots the parts of the meta-objective and the validation success, with floors, ceiling and test result.

    Args:
        metrics: lines with "step" and "action_loss", perhaps "goal_loss", or "validation_success".
        evaluation: the run's evaluation.json.
        path: image file to write.
    """
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.set(xlabel="meta-updates", yscale="log", title="after adaptation")
    parts = [("action_loss", "squared error of the actions", left, "tab:blue")]
    if any("goal_loss" in line for line in metrics):
        parts.append(("goal_loss", "goal: negative log likelihood", left.twinx(), "tab:red"))
    for name, label, axis, color in parts:
        values = [(line["step"], line[name]) for line in metrics if name in line]
        axis.plot(*zip(*values, strict=True), color=color, lw=1)
        axis.set_ylabel(label, color=color)
    valid = [(line["step"], line["validation_success"]) for line in metrics if "validation_success" in line]
    right.plot(*zip(*valid, strict=True), "o-", color="tab:blue", label="validation")
    low, high = evaluation["wilson95"]
    success = evaluation["success"]
    last = valid[-1][0]
    error = [[success - low], [high - success]]
    right.errorbar([last], [success], error, fmt="s", color="black", label="test, 95%")
    for (name, value), color in zip(evaluation["baselines"].items(), ("0.6", "tab:orange", "tab:green"), strict=False):
        right.axhline(value, color=color, ls="--", lw=1, label=name.replace("_", "-"))
    right.set(xlabel="meta-updates", ylabel="success", ylim=(0, 1.02))
    right.legend(fontsize=8)
    figure.savefig(path, dpi=120)


def action_errors(metrics: list[dict[str, Any]], evaluation: dict[str, Any], path: pathlib.Path) -> None:
    """Plots the meta-objective and the validation score, and the errors of the actions on test tasks.

    Args:
        metrics: lines with "step" and "action_loss", or "validation_score".
        evaluation: the run's evaluation.json.
        path: image file to write.
    """
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    for axis, name, title in ((left, "action_loss", "after adaptation"), (middle, "validation_score", "validation")):
        values = [(line["step"], line[name]) for line in metrics if name in line]
        axis.plot(*zip(*values, strict=True), "-o" if axis is middle else "-", lw=1)
        axis.set(xlabel="meta-updates", ylabel=name.replace("_", " "), title=title)
    errors = evaluation["action_error"]
    names = [name for name in ("mean_action", "before", "other_task", "after") if name in errors]
    bars = right.bar([name.replace("_", "\n") for name in names], [errors[name] for name in names], color="0.7")
    bars[-1].set_color("tab:blue")
    right.set(title=f"test, {errors['tasks']} tasks", ylabel="squared error of the actions")
    figure.savefig(path, dpi=120)


def side_by_side(demo: np.ndarray, trial: np.ndarray, path: pathlib.Path, fps: int = 20) -> None:
    """Writes an animation: the demonstration on the left, the policy on the right.

    Args:
        demo: [M, T, H, W, 3] uint8, M demonstrations.
        trial: [M, T, H, W, 3] uint8, the policy's rollouts on the same tasks.
        path: a .gif file.
        fps: frames per second.
    """
    gap = np.full((*demo.shape[1:3], 8, 3), 255, np.uint8)
    clips = [np.concatenate([left, gap, right], axis=2) for left, right in zip(demo, trial, strict=True)]
    # The last frame stays for half a second before the next task begins.
    frames = np.concatenate([np.concatenate([clip, np.repeat(clip[-1:], fps // 2, axis=0)]) for clip in clips])
    iio.imwrite(path, frames, extension=".gif", duration=1000 / fps, loop=0)
