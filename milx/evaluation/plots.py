"""Plots and videos of a run."""

import pathlib
from typing import TYPE_CHECKING, Any

import imageio.v3 as iio
import numpy as np

from milx.core import files
from milx.evaluation import listening

if TYPE_CHECKING:  # importing matplotlib takes half a second, which no run should wait for before its first line
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def learning_curve(metrics: list[dict[str, Any]], evaluation: dict[str, Any], path: pathlib.Path) -> None:
    """Plots whether the policy listens, how far the inner step moves it, and its success beside the baselines.

    Args:
        metrics: lines with "step" and what `listening.measure` found, perhaps "goal_loss", or "validation_success".
        evaluation: the run's evaluation.json.
        path: image file to write.
    """
    figure = _figure(14)
    left, middle, right = figure.subplots(1, 3)
    _listening(left, metrics)
    if any("goal_loss" in line for line in metrics):
        axis = left.twinx()
        axis.plot(*_curve(metrics, "goal_loss"), color="tab:red", lw=1)
        axis.set_ylabel("goal: negative log likelihood", color="tab:red")
    middle.set(xlabel="meta-updates", yscale="log", title="the inner step, by tensor (change / size)")
    for name in sorted({name for line in metrics for name in line if name.startswith("step/")}):
        steps, sizes = _curve(metrics, name)
        moved = [(step, size) for step, size in zip(steps, sizes, strict=True) if size > 0]
        if moved and not name.endswith(("bias", "centre")):
            middle.plot(*zip(*moved, strict=True), lw=1, label=name.removeprefix("step/policy."))
    if middle.lines:
        middle.legend(fontsize=5)
    steps, valid = _curve(metrics, "validation_success")
    right.plot(steps, valid, "o-", color="tab:blue", label="validation")
    low, high = evaluation["wilson95"]
    success = evaluation["success"]
    error = [[success - low], [high - success]]
    right.errorbar([steps[-1]], [success], error, fmt="s", color="black", label="test, 95%")
    colors = ("0.6", "tab:orange", "tab:green", "tab:purple")
    for (name, value), color in zip(evaluation["baselines"].items(), colors, strict=True):
        right.axhline(value, color=color, ls="--", lw=1, label=name.replace("_", "-"))
    right.set(xlabel="meta-updates", ylabel="success", ylim=(0, 1.02))
    right.legend(fontsize=8)
    _save(figure, path)


def _save(figure: "Figure", path: pathlib.Path) -> None:
    with files.replacing(path) as partial:
        figure.savefig(partial, dpi=120, format="png")


def _figure(width: float) -> "Figure":
    """Makes a figure so wide (inches)."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, 3.6), layout="constrained")


def _listening(axis: "Axes", metrics: list[dict[str, Any]]) -> None:
    """Plots the errors of `listening.measure`: on training tasks as lines, on validation tasks as dots."""
    axis.set(xlabel="meta-updates", ylabel="squared error of the actions (1: a constant)", title="does it listen?")
    for (name, words), color in zip(listening.ERRORS.items(), ("tab:blue", "tab:orange", "0.6"), strict=True):
        if any(name in line for line in metrics):
            axis.plot(*_curve(metrics, name), color=color, lw=1, label=f"{words} demonstration")
            axis.plot(*_curve(metrics, f"validation_{name}"), "o", color=color, ms=3)
    axis.plot([], [], "o", color="black", ms=3, label="the same on validation tasks")
    axis.set_ylim(0, min(axis.get_ylim()[1], 2.0))
    axis.legend(fontsize=8, loc="upper right")


def _curve(metrics: list[dict[str, Any]], name: str) -> tuple[list[int], list[float]]:
    """Reads the steps whose line has this number, and the numbers."""
    lines = [line for line in metrics if name in line]
    return [line["step"] for line in lines], [line[name] for line in lines]


def action_errors(metrics: list[dict[str, Any]], evaluation: dict[str, Any], path: pathlib.Path) -> None:
    """Plots whether the policy listens, the validation score, and the errors of the actions on test tasks.

    Args:
        metrics: lines with "step" and what `listening.measure` found, or "validation_score".
        evaluation: the run's evaluation.json.
        path: image file to write.
    """
    figure = _figure(10)
    left, middle, right = figure.subplots(1, 3)
    _listening(left, metrics)
    middle.plot(*_curve(metrics, "validation_score"), "-o", lw=1)
    middle.set(xlabel="meta-updates", ylabel="validation score", title="validation")
    errors = evaluation["action_error"]
    names = [name for name in ("mean_action", "before", "other_task", "after") if name in errors]
    bars = right.bar([name.replace("_", "\n") for name in names], [errors[name] for name in names], color="0.7")
    bars[-1].set_color("tab:blue")
    right.set(title=f"test, {errors['tasks']} tasks", ylabel="squared error of the actions")
    _save(figure, path)


def side_by_side(left: np.ndarray, right: np.ndarray, path: pathlib.Path, fps: int = 20) -> None:
    """Writes an animation of pairs of films, one pair after the other, say of demonstrations and a policy.

    Args:
        left: [M, T, H, W, 3] uint8.
        right: [M, T, H, W, 3] uint8.
        path: a .gif file.
        fps: frames per second.
    """
    gap = np.full((*left.shape[1:3], 8, 3), 255, np.uint8)
    clips = [np.concatenate([one, gap, other], axis=2) for one, other in zip(left, right, strict=True)]
    # The last frame stays for half a second before the next pair begins.
    frames = np.concatenate([np.concatenate([clip, np.repeat(clip[-1:], fps // 2, axis=0)]) for clip in clips])
    with files.replacing(path) as partial:
        iio.imwrite(partial, frames, extension=".gif", duration=1000 / fps, loop=0)
