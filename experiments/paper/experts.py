"""Who demonstrates push more reliably: its controller, with and without a choice of tactics, or iLQR started from it.

    python experiments/paper/experts.py    # on a GPU: iLQR takes long to compile
    python experiments/paper/experts.py --experts=controller --experts=one-tactic    # on a CPU, too

Training and validation scenes, without and with noise on the actions. A plan's feedback is linear around one
trajectory; the controller answers to where the object is. What has its file is not run again.
"""

import pathlib
import time
from typing import Any

import jax
from absl import app, flags

import milx
from milx import envs
from milx.config.schema import DataConfig, EvalConfig
from milx.core import files
from milx.data.simulated import collect
from milx.evaluation import provenance
from milx.evaluation.closed_loop import evaluate_baselines
from milx.evaluation.intervals import wilson_interval

EXPERTS = {"controller": 0, "one-tactic": 0, "ilqr": 5}
"""By name, the most iterations of iLQR."""
NOISE = (0.0, 0.1)
"""Standard deviation on the actions; the presets' is the last."""
_EXPERTS = flags.DEFINE_multi_enum("experts", list(EXPERTS), list(EXPERTS), "Which (repeat the flag).")
_OUT = flags.DEFINE_string("out", "experiments/results/experts", "Folder of the JSON files.")
_SCENES = flags.DEFINE_integer("scenes", 512, "Scenes of each split, each of another task.", lower_bound=1)


def compare(name: str, scenes: int) -> list[dict[str, Any]]:
    """Measures the success of an expert for each split and noise, with baselines beside the controller's.

    The seconds of the first entry include compilation.
    """
    env, key, found = envs.make("push", (16, 16)), jax.random.key(0), []
    if name == "one-tactic":
        env.tactics = env.tactics[:1]
    for split in ("train", "validation"):
        for noise in NOISE:
            began = time.perf_counter()
            config = DataConfig(noise=noise, plan_iterations=EXPERTS[name], plan_batch=256)
            demos = collect(env, key, split, scenes, 1, config)
            count = int(demos.success.sum())
            row: dict[str, Any] = {
                "split": split,
                "noise": noise,
                "success": count / scenes,
                "wilson95": wilson_interval(count, scenes),
            }
            found.append(row | {"seconds": time.perf_counter() - began})
            print(name, found[-1], flush=True)
        if name == "controller":
            baselines = evaluate_baselines(env, demos, EvalConfig(trials=1, baseline_trials=1, batch=128), config, key)
            found[-1]["baselines"] = baselines.success
            print(name, split, baselines.success, flush=True)
    return found


def main(_: list[str]) -> None:
    """Runs what is missing."""
    milx.configure()
    folder = pathlib.Path(_OUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    for name in _EXPERTS.value:
        path = folder / f"push-{name}.json"
        if not path.is_file():
            contents = {"expert": name, "scenes": _SCENES.value, "ilqr_iterations": EXPERTS[name]}
            files.write_json(path, contents | {"runs": compare(name, _SCENES.value)} | provenance.origin())


if __name__ == "__main__":
    app.run(main)
