"""A board: policies that are trained on Meta-World's demonstrations and act in Meta-World (`meta_world.py`).

    python board.py SET --runs=RUNS                                    # trains, on a GPU
    python board.py SET --runs=RUNS --python=../../.mw/bin/python      # also acts in the world and prints the table
    python board.py --show
    python board.py UNSEEN --unseen --runs=RUNS --rows=lstm --rows=mil-one-action --episodes=25

SET is what `meta_world.py` says how to record, and UNSEEN what `unseen.py` does. What is finished is not done again.
"""

import pathlib
from typing import Any

from absl import app, flags

import milx
from milx.config import assemble
from milx.config.schema import Config
from milx.core import files
from milx.training.recorded import RecordedRun, config_for
from milx.worlds import report
from milx.worlds.actor import CONTROLS

RESULTS = {
    world: pathlib.Path(__file__).parents[1] / "results" / folder
    for world, folder in (("meta_world:make", "meta_world"), ("unseen:make", "meta_world_unseen"))
}
"""The folder of the results by the world in which policies act."""
COMMON: dict[str, Any] = {
    "network.kernel": 3,
    "network.goal_head": False,
    "method.goal_weight": 0.0,
    "method.chunk": 4,
    "optimizer.learning_rate": 1e-3,
    "train.query_frames": 12,
    "train.steps": 20_000,
    "train.eval_every": 10_000,
}
"""What all rows set, by dotted name."""
_FINE = {"network.strides": (2, 1, 1, 1)}
_GOAL_HEAD = {"network.goal_head": True, "method.goal_weight": 1.0, "recorded.goal_indices": (0, 1, 2)}
_MIL = _FINE | {"train.support_frames": 10, "train.steps": 10_000, "train.eval_every": 5000}
_CONTEXTUAL = _FINE | {"network.context": 64}
ROWS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "mil": ("MIL + learned rates, chunks", "mil", _MIL),
    "mil-goal": ("MIL + learned rates, chunks, goal head", "mil", _MIL | _GOAL_HEAD),
    "contextual": ("contextual + chunks", "contextual", _CONTEXTUAL),
    "contextual-goal": ("contextual + chunks, goal head", "contextual", _CONTEXTUAL | _GOAL_HEAD),
    "contextual-wide": (
        "contextual + chunks, 64 filters, Muon",
        "contextual",
        _CONTEXTUAL | {"network.filters": (64,) * 4, "optimizer.name": "muon"},
    ),
    "lstm": ("LSTM + chunks", "lstm", {"network.strides": (2, 1, 2, 1), "network.context": 256}),
    "mil-longer": (
        "MIL + learned rates, chunks; 20,000 updates",
        "mil",
        _MIL | {"train.steps": 20_000, "train.eval_every": 10_000},
    ),
    "mil-coarse": ("MIL + learned rates, chunks; strides 2, 2, 2, 1", "mil", _MIL | {"network.strides": (2, 2, 2, 1)}),
    "mil-defaults": (
        "MIL + learned rates; strides 2, 2, 2, 1: the defaults of --data",
        "mil",
        _MIL | {"network.strides": (2, 2, 2, 1), "method.chunk": 1, "train.eval_every": 1000},
    ),
    "mil-one-action": ("MIL + learned rates", "mil", _MIL | {"method.chunk": 1}),
    "mil-few-frames": (
        "MIL + learned rates, chunks; 4 and 8 time steps",
        "mil",
        _MIL | {"train.support_frames": 4, "train.query_frames": 8},
    ),
}
"""Policies by name: what the table calls them, the method, and what else differs."""


_WITHOUT = ("replay", "mean_action", "random")
"""What acts without a policy."""


def configure(row: str, data: str, seed: int) -> Config:
    """Configures a policy of the board."""
    _, method, changes = ROWS[row]
    config = config_for(data, method, "fast", seed)
    for name, value in (COMMON | changes).items():
        assemble.assign(config, name, value)
    return config


def judged(config: Config, folder: pathlib.Path, world: str, **options: Any) -> dict[str, Any]:
    """Lets a trained policy act in the world, and returns the result of its training with that of the world."""
    report.report_on(config, folder, world, **options)
    trained, acted = (files.read_json(folder / name) for name in ("evaluation.json", report.FILE))
    origin = {name: acted[name] for name in ("commit", "hardware", "versions")}
    return trained | {"world": {name: acted[name] for name in ("criterion", "tasks", "controls", "lost")} | origin}


def markdown(found: dict[str, dict[str, Any]]) -> str:
    """Writes a table of what there is: success at any time, over all tasks and by family, after what was shown.

    What acts without a policy comes last, and once where it came to the same numbers.
    """
    families = sorted({family for run in found.values() for family in run["world"]["controls"]["own"]["families"]})
    header = ["", "after", "success (95%)", "at the end", "episodes", *(name.removesuffix("-v3") for name in families)]
    lines = [f"| {' | '.join(header)} |", "|---" * len(header) + "|"]
    without: list[str] = []
    for name, run in found.items():
        label, seed = ROWS[name.rpartition("-")[0]][0], name.rpartition("-")[2]
        for control, rates in run["world"]["controls"].items():
            low, high = rates["ever_wilson95"]
            who = "no policy" if control in _WITHOUT else f"{label}, seed {seed}"
            columns = [who, CONTROLS[control], f"{rates['ever']:.1%} ({low:.0%} to {high:.0%})"]
            columns += [f"{rates['end']:.1%}", str(rates["episodes"])]
            columns += [f"{rates['families'][family]['ever']:.0%}" for family in families]
            (without if control in _WITHOUT else lines).append(f"| {' | '.join(columns)} |")
    return "\n".join([*lines, *dict.fromkeys(without)])


def read(world: str = "meta_world:make") -> dict[str, dict[str, Any]]:
    """Reads the results in a world, by row and seed."""
    return {path.stem: files.read_json(path) for path in sorted(RESULTS[world].glob("*.json"))}


def main(argv: list[str]) -> None:
    """Runs what is missing and prints the table."""
    milx.configure()
    if not _SHOW.value and len(argv) != 2:
        raise app.UsageError("expected one argument, SET")
    world = "unseen:make" if _UNSEEN.value else "meta_world:make"
    for row in [] if _SHOW.value else _ROWS.value:
        for seed in range(_SEEDS.value):
            config, name = configure(row, argv[1], seed), f"{row}-{seed}"
            path = RESULTS[world] / f"{name}.json"
            if path.exists():
                continue
            run = RecordedRun(config, pathlib.Path(_RUNS.value) / name)
            run.train()
            if not (run.folder / "evaluation.json").exists():
                run.report(run.evaluate())
            if _PYTHON.value:
                options = {"python": _PYTHON.value, "workers": _WORKERS.value, "episodes": _EPISODES.value}
                result = judged(config, run.folder, world, **options)
                result["config"]["recorded"]["path"] = pathlib.Path(argv[1]).name
                files.write_json(path, result)
    print(markdown(read(world)))


if __name__ == "__main__":
    _ROWS = flags.DEFINE_multi_enum("rows", list(ROWS), list(ROWS), "Which policies; may be repeated.")
    _SEEDS = flags.DEFINE_integer("seeds", 1, "Seeds of each.")
    _RUNS = flags.DEFINE_string("runs", "runs", "The folder of the runs.")
    _PYTHON = flags.DEFINE_string("python", None, "The interpreter that runs Meta-World; none to train only.")
    _WORKERS = flags.DEFINE_integer("workers", 2, "Worlds at once.")
    _EPISODES = flags.DEFINE_integer("episodes", 2, "Episodes of every test task and control.")
    _UNSEEN = flags.DEFINE_bool("unseen", False, "Unseen kinds of tasks.")
    _SHOW = flags.DEFINE_bool("show", False, "Print what there is, and run nothing.")
    app.run(main)
