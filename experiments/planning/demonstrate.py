"""Demonstrations by optimization alone: how many succeed under the preset's noise, and how long it takes to plan them.

    python experiments/planning/demonstrate.py                                # 9,216 scenes of push, on a GPU
    python experiments/planning/demonstrate.py --envs=reach --envs=place --scenes=512 --batch=128
    python experiments/planning/demonstrate.py --envs=place --scenes=64 --batch=64    # on two cores
    python experiments/planning/demonstrate.py --envs=grasp --expert=receding --scenes=512
    python experiments/planning/demonstrate.py --envs=grasp --expert=receding --scenes=512 --physics=warp
    python experiments/planning/demonstrate.py --envs=push --expert=ppo --batch=2048
    python experiments/planning/demonstrate.py --envs=push --expert=pretrained --scenes=512    # on two cores

Plans as a run with this `data.expert` does (`milx.data.experts`). With "sampling" the plans with which all scenes begin
are searched for first, in 256 other scenes, and with "ppo" a network learns first. Nothing comes from a cache. No
setting was chosen by these scenes. All of them draw the same candidates, or have one network, so that the intervals are
those for this one draw.
"""

import dataclasses
import os
import pathlib
import tempfile
import time
from collections.abc import Iterator
from typing import Any

import jax
from absl import app, flags

import milx
from milx import envs
from milx.config.assemble import make_config
from milx.config.schema import PHYSICS, DataConfig
from milx.core import files, pytrees
from milx.data import experts
from milx.data.simulated import collect
from milx.envs.base import Env
from milx.evaluation import provenance
from milx.evaluation.intervals import wilson_interval
from milx.trajopt.expert import Learned, Sampling

FIRST_SEED = 1000
"""Of the scenes; push.py and the trials by which settings were chosen have smaller ones."""
ITERATIONS = {"sampling": 8, "receding": 1, "ppo": 500, "pretrained": 1}
SETTINGS = {
    "sampling": experts.SETTINGS,
    "receding": experts.RECEDING,
    "ppo": experts.LEARNED,
    "pretrained": experts.LEARNED,
}


def measure(env: Env, config: DataConfig, scenes: int) -> Iterator[dict[str, Any]]:
    """Plans and executes `scenes` scenes, rounded up to whole batches, and yields what is known after each batch."""
    began, batch = time.perf_counter(), config.plan_batch
    expert = experts.expert_of(env, config)
    known: dict[str, Any] = {}
    counts: list[int] = []
    if isinstance(expert, Sampling):
        known = {"plans_to_begin_with": int(expert.plans.success.sum())}
    if isinstance(expert, Learned):
        known = {"actor": pytrees.fingerprint(expert.actor)}
    seconds = {"before the first demonstration, with compilation": time.perf_counter() - began}
    for number in range(-(-scenes // batch)):
        demos = collect(env, jax.random.key(FIRST_SEED + number), "train", batch, 1, config)
        counts.append(int(demos.success.sum()))
        made, total = batch * len(counts), time.perf_counter() - began
        yield {
            **known,
            "scenes": made,
            "success": sum(counts) / made,
            "wilson95": wilson_interval(sum(counts), made),
            "success_by_batch": [count / batch for count in counts],
            "seconds": {**seconds, "total, with compilation": total},
            "scenes_per_second": made / total,
        }


def main(_: list[str]) -> None:
    """Measures, and writes the files."""
    temporary = tempfile.TemporaryDirectory()
    os.environ["XDG_CACHE_HOME"] = temporary.name
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    milx.configure()
    origin = provenance.origin()  # before a file of another commit is replaced
    folder = pathlib.Path(_OUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    for name in _ENVS.value:
        config = make_config(name, preset="fast").data
        expert = _EXPERT.value
        changes: dict[str, Any] = {"expert": expert, "plan_iterations": ITERATIONS[expert], "plan_batch": _BATCH.value}
        config = dataclasses.replace(config, **changes)
        env, settings = envs.make(name, (16, 16)), {"first_seed": FIRST_SEED, "physics": _PHYSICS.value}
        env = env.by_warp() if _PHYSICS.value == "warp" else env
        of_expert: Any = SETTINGS[expert]
        settings |= dataclasses.asdict(of_expert) | ({"ahead": env.ahead} if expert == "receding" else {})
        for found in measure(env, config, _SCENES.value):
            said = {"env": name, "data": dataclasses.asdict(config), "settings": settings}
            result = {**said, **found, **origin}
            others = [value for value in (expert, _PHYSICS.value) if value not in ("sampling", "jax")]
            files.write_json(folder / f"{'-'.join(['demonstrations', name, *others])}.json", result)
            (low, high), newest = found["wilson95"], found["success_by_batch"][-1]
            total = found["seconds"]["total, with compilation"]
            print(
                f"{name} {newest:.1%}; {found['success']:.2%} ({low:.2%} to {high:.2%}) of {found['scenes']} "
                f"in {total:.0f} s",
                flush=True,
            )


if __name__ == "__main__":
    _ENVS = flags.DEFINE_multi_enum("envs", ["push"], list(envs.ENVS), "Which environments (repeat the flag).")
    _EXPERT = flags.DEFINE_enum("expert", "sampling", list(ITERATIONS), "Who demonstrates.")
    _PHYSICS = flags.DEFINE_enum("physics", "jax", list(PHYSICS), "Who steps the worlds.")
    _SCENES = flags.DEFINE_integer("scenes", 9216, "Scenes, each of another task.", lower_bound=1)
    _BATCH = flags.DEFINE_integer("batch", 512, "Scenes at once.", lower_bound=1)
    _OUT = flags.DEFINE_string("out", "experiments/results/planning", "Folder of the JSON files.")
    app.run(main)
