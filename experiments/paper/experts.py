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
import jax.numpy as jnp
from absl import app, flags
from push_controller import TACTICS, Controlled, control

import milx
from milx.config.schema import DataConfig, EvalConfig
from milx.core import files
from milx.data import experts
from milx.data.simulated import collect
from milx.envs.base import State
from milx.envs.push.env import Push, PushTask
from milx.evaluation import provenance
from milx.evaluation.closed_loop import evaluate_baselines
from milx.evaluation.intervals import wilson_interval

EXPERTS = {"controller": 0, "one-tactic": 0, "ilqr": 5}
"""By name, the most iterations of iLQR."""
experts.EXPERTS["one-tactic"] = experts.Kind(
    lambda *_: Controlled(control, TACTICS[:1]), lambda *_: ["one-tactic"], plans=False
)
NOISE = (0.0, 0.1)
"""Standard deviation on the actions; the last is that of `paper` and `fast`."""
_EXPERTS = flags.DEFINE_multi_enum("experts", list(EXPERTS), list(EXPERTS), "Which (repeat the flag).")
_OUT = flags.DEFINE_string("out", "experiments/results/experts", "Folder of the JSON files.")
_SCENES = flags.DEFINE_integer("scenes", 512, "Scenes of each split, each of another task.", lower_bound=1)


class FromController(Push):
    """Push where iLQR begins with what the controller does without a choice of tactics."""

    def guess(self, task: PushTask, state: State) -> jax.Array:
        """Returns [T, 7], what the controller does from here."""

        def step(state: State, _: None) -> tuple[State, jax.Array]:
            action = control(self, task, state, jnp.asarray(TACTICS[0]))
            return self.step(task, state, action), action

        return jax.lax.scan(step, state, length=self.horizon)[1]


def compare(name: str, scenes: int) -> list[dict[str, Any]]:
    """Measures the success of an expert for each split and noise, with baselines beside the controller's.

    The seconds of the first entry include compilation.
    """
    env, key, found = FromController((16, 16)), jax.random.key(0), []
    for split in ("train", "validation"):
        for noise in NOISE:
            began = time.perf_counter()
            config = DataConfig(noise=noise, expert=name, plan_iterations=EXPERTS[name], plan_batch=256)
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
