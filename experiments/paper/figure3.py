r"""Figure 3 of the paper: success against the number of training demonstrations, from pixels and from states.

    python experiments/paper/figure3.py                    # what is missing, then the figure
    python experiments/paper/figure3.py --envs=push --tasks=48,192,768 --steps=15000 \
        --out=experiments/results/figure3_push
    python experiments/paper/figure3.py --envs=reach --preset=paper \
        --out=experiments/results/figure3_paper            # as published
    python experiments/paper/figure3.py --preset=cpu --steps=200 --out=tiny --tasks=6,12 --seeds=1 --end_seeds=1

Stopped and started again it goes on with its last checkpoint.
"""

import collections
import pathlib
import statistics
from typing import Any, NamedTuple

import cells
import matplotlib.pyplot as plt
import options
import table
from absl import app, flags

import milx
from milx.evaluation.results import intervals

TITLES = {
    "reach": "vision, held-out colors",
    "reach_state": "state, held-out scenes",
    "push": "push, held-out objects and textures",
    "place": "place, held-out objects and textures",
    "grasp": "grasp, held-out objects and textures",
}

flags.adopt_module_key_flags(options)
_FIGURE = flags.DEFINE_string("figure", None, "Where to draw; default figure3.png in the folder.")
_ENVS = flags.DEFINE_list("envs", ["reach", "reach_state"], "Environments.")
_METHODS = flags.DEFINE_list("methods", None, "Methods; default all.")
_TASKS = flags.DEFINE_list("tasks", ["50", "150", "500", "1500"], "Training tasks; each must divide the last.")
_END_SEEDS = flags.DEFINE_integer("end_seeds", 3, "Seeds of the smallest and of the largest.")


def run_cells() -> None:
    """Runs what is missing, the first seeds first."""
    sizes = [int(tasks) for tasks in _TASKS.value]
    runner = cells.Cells(options.folder("figure3"), sizes[-1])
    for env in _ENVS.value:
        for seed in range(max(options.SEEDS.value, _END_SEEDS.value)):
            for method in cells.methods_of(env, _METHODS.value):
                for tasks in reversed(sizes):
                    at_end = tasks in (sizes[0], sizes[-1])
                    if seed < (_END_SEEDS.value if at_end else options.SEEDS.value):
                        config = cells.configure(env, method, options.PRESET.value, seed, options.STEPS.value)
                        config.data.tasks = tasks
                        runner.run({f"{env}-{method}-{tasks}-{seed}": config})


class Point(NamedTuple):
    """Success of a method from so many demonstrations: mean of the seeds, lowest and highest end of their intervals."""

    mean: float
    low: float
    high: float
    seeds: int


def points(results: list[dict[str, Any]]) -> dict[tuple[str, str], dict[int, Point]]:
    """Collects the curve of every environment and method: points by the number of demonstrations, in order."""
    groups = collections.defaultdict(list)
    for result in results:
        groups[result["env"], result["method"], result["num_demos_train"]].append(result)
    curves: dict[tuple[str, str], dict[int, Point]] = collections.defaultdict(dict)
    for (env, method, size), runs in sorted(groups.items()):
        ends = intervals(runs)
        mean = statistics.mean(run["success"] for run in runs)
        low, high = min(end[0] for end in ends), max(end[1] for end in ends)
        curves[env, method][size] = Point(mean, low, high, len(runs))
    return curves


def _labels(results: list[dict[str, Any]]) -> dict[tuple[str, str], str]:
    """Names every method in every environment."""
    return {(result["env"], result["method"]): table.method(result) for result in results}


def markdown(results: list[dict[str, Any]]) -> str:
    """Writes the figure as a table."""
    curves, labels = points(results), _labels(results)
    sizes = sorted({size for curve in curves.values() for size in curve})
    lines = ["| | " + " | ".join(f"{size:,}" for size in sizes) + " |", "|---|" + "---|" * len(sizes)]
    for env, methods in cells.METHODS.items():
        for method in methods:
            curve = curves.get((env, method), {})
            shown = [
                f"{curve[size].mean:.1%} ({curve[size].low:.1%} to {curve[size].high:.1%}; {curve[size].seeds})"
                if size in curve
                else ""
                for size in sizes
            ]
            if curve:
                lines.append(f"| {env}: {labels[env, method]} | {' | '.join(shown)} |")
    return "\n".join(lines)


def draw(results: list[dict[str, Any]], path: pathlib.Path) -> None:
    """Draws one panel for each environment: mean of the seeds, a band from the lowest to the highest interval's end."""
    curves, labels = points(results), _labels(results)
    names = [env for env in cells.METHODS if any(env == key[0] for key in curves)]
    figure, axes = plt.subplots(1, len(names), figsize=(4.5 * len(names), 3.6), squeeze=False, layout="constrained")
    for axis, env in zip(axes[0], names, strict=True):
        for method in cells.METHODS[env]:
            curve = curves.get((env, method), {})
            mean, low, high = ([100 * point[i] for point in curve.values()] for i in range(3))
            (line,) = axis.plot(list(curve), mean, marker="o", label=labels[env, method])
            axis.fill_between(list(curve), low, high, color=line.get_color(), alpha=0.2)
        baselines = next(result["baselines"] for result in results if result["env"] == env)
        for name, style in (("random", ":"), ("task_blind", "--"), ("expert", "-.")):
            axis.axhline(100 * baselines[name], color="gray", linestyle=style, label=name.replace("_", "-"))
        axis.set(xscale="log", title=TITLES[env], xlabel="demonstrations for meta-training", ylim=(0, 100))
        sizes = sorted({size for key, curve in curves.items() if key[0] == env for size in curve})
        axis.set_xticks(sizes, [f"{size:,}" for size in sizes], fontsize=7, rotation=30)
        axis.minorticks_off()
    axes[0, 0].set_ylabel("success (%)")
    axes[0, -1].legend(fontsize=7)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(_: list[str]) -> None:
    """Runs and draws."""
    milx.configure()
    if not options.SHOW.value:
        run_cells()
    folder = options.folder("figure3")
    results = list(cells.read(folder).values())
    print(markdown(results))
    draw(results, pathlib.Path(_FIGURE.value or folder / "figure3.png"))


if __name__ == "__main__":
    app.run(main)
