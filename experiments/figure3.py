"""Figure 3 of the paper: success against the number of training demonstrations, from pixels and from states.

    python experiments/figure3.py                    # what is missing, then the figure
    python experiments/figure3.py --envs=push --tasks=48,192,768 --out=experiments/results/figure3_push
    python experiments/figure3.py --preset=cpu --steps=200 --out=tiny --tasks=6,12 --seeds=1 --end_seeds=1

Stopped and started again it goes on with the next cell.
"""

import collections
import pathlib
import statistics
from typing import Any

import cells
import matplotlib.pyplot as plt
from absl import app, flags

LABELS = {"mil": "MIL", "contextual": "contextual", "lstm": "LSTM", "lstm_attention": "LSTM with attention"}
TITLES = {
    "reach": "vision, held-out colours",
    "reach_state": "state, held-out scenes",
    "push": "push, held-out objects and textures",
}

_HERE = pathlib.Path(__file__).parent
_OUT = flags.DEFINE_string("out", str(_HERE / "results" / "figure3"), "Folder of the JSON files.")
_FIGURE = flags.DEFINE_string("figure", None, "Where to draw; default figure3.png in the folder.")
_PRESET = flags.DEFINE_string("preset", "fast", "Hyperparameters.")
_ENVS = flags.DEFINE_list("envs", ["reach", "reach_state"], "Environments.")
_METHODS = flags.DEFINE_list("methods", None, "Methods; default all.")
_STEPS = flags.DEFINE_integer("steps", None, "Meta-updates of every cell; default as in cells.py.")
_TASKS = flags.DEFINE_list("tasks", ["50", "150", "500", "1500"], "Training tasks; each must divide the last.")
_SEEDS = flags.DEFINE_integer("seeds", 2, "Seeds of each cell.")
_END_SEEDS = flags.DEFINE_integer("end_seeds", 3, "Seeds of the smallest and of the largest.")


def run_cells() -> None:
    """Runs what is missing, the first seeds first."""
    sizes = [int(tasks) for tasks in _TASKS.value]
    runner = cells.Cells(pathlib.Path(_OUT.value), sizes[-1])
    for env in _ENVS.value:
        for seed in range(max(_SEEDS.value, _END_SEEDS.value)):
            for method in cells.methods_of(env, _METHODS.value):
                for tasks in reversed(sizes):
                    at_end = tasks in (sizes[0], sizes[-1])
                    if seed < (_END_SEEDS.value if at_end else _SEEDS.value):
                        config = cells.configure(env, method, _PRESET.value, seed, _STEPS.value or cells.STEPS[env])
                        config.data.tasks = tasks
                        runner.run(f"{env}-{method}-{tasks}-{seed}", config)


def draw(results: list[dict[str, Any]], path: pathlib.Path) -> None:
    """One panel for each environment: mean of the seeds, a band from the lowest to the highest interval's end."""
    groups = collections.defaultdict(list)
    for result in results:
        groups[result["env"], result["method"], result["num_demos_train"]].append(result)
    names = [env for env in cells.METHODS if any(env == key[0] for key in groups)]
    figure, axes = plt.subplots(1, len(names), figsize=(4.5 * len(names), 3.6), squeeze=False, layout="constrained")
    for axis, env in zip(axes[0], names, strict=True):
        for method in cells.METHODS[env]:
            sizes = sorted(key[2] for key in groups if key[:2] == (env, method))
            cell = [groups[env, method, size] for size in sizes]
            means = [100 * statistics.mean(result["success"] for result in runs) for runs in cell]
            low = [100 * min(result["wilson95"][0] for result in runs) for runs in cell]
            high = [100 * max(result["wilson95"][1] for result in runs) for runs in cell]
            (line,) = axis.plot(sizes, means, marker="o", label=LABELS[method])
            axis.fill_between(sizes, low, high, color=line.get_color(), alpha=0.2)
        floors = next(result["baselines"] for result in results if result["env"] == env)
        for name, style in (("random", ":"), ("task_blind", "--"), ("expert", "-.")):
            axis.axhline(100 * floors[name], color="gray", linestyle=style, label=name.replace("_", "-"))
        axis.set(xscale="log", title=TITLES[env], xlabel="demonstrations for meta-training", ylim=(0, 100))
    axes[0, 0].set_ylabel("success (%)")
    axes[0, -1].legend(fontsize=7)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main(_: list[str]) -> None:
    """Runs and draws."""
    run_cells()
    folder = pathlib.Path(_OUT.value)
    draw(list(cells.read(folder).values()), pathlib.Path(_FIGURE.value or folder / "figure3.png"))


if __name__ == "__main__":
    app.run(main)
