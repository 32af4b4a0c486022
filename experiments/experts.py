"""Who demonstrates push more reliably: its controller, with and without a choice of tactics, or iLQR started from it.

    python experiments/experts.py                                              # on a GPU: iLQR takes long to compile
    python experiments/experts.py --experts=controller --experts=one-tactic    # on a CPU, too

Training and validation scenes, without and with noise on the actions. A plan's feedback is linear around one
trajectory; the controller answers to where the object is. What has its file is not run again.
"""

import functools
import pathlib
import time
from typing import Any

import jax
from absl import app, flags

from milx import envs, provenance, results
from milx.chunks import map_in_chunks
from milx.evaluator import wilson_interval
from milx.trajopt.expert import judge, perform
from milx.trajopt.ilqr import Options

EXPERTS = {"controller": 0, "one-tactic": 0, "ilqr": 5}
"""By name, the most iterations of iLQR."""
NOISE = (0.0, 0.1)
"""Standard deviation on the actions; the presets' is the last."""
_EXPERTS = flags.DEFINE_multi_enum("experts", list(EXPERTS), list(EXPERTS), "Which (repeat the flag).")
_OUT = flags.DEFINE_string("out", "experiments/results/experts", "Folder of the JSON files.")
_SCENES = flags.DEFINE_integer("scenes", 512, "Scenes of each split, each of another task.", lower_bound=1)


def compare(name: str, scenes: int) -> list[dict[str, Any]]:
    """Success of an expert for each split and noise; of the controller also blind to the task.

    The seconds of the first entry include compilation.
    """
    env, options = envs.make("push", (16, 16)), Options(iterations=EXPERTS[name])
    if name == "one-tactic":
        env.tactics = env.tactics[:1]
    found = []
    for split in ("train", "validation"):
        task_keys, scene_keys, keys = (jax.random.split(key, scenes) for key in jax.random.split(jax.random.key(0), 3))
        tasks = jax.vmap(lambda key, split=split: env.sample_task(key, split))(task_keys)
        states = jax.vmap(env.reset)(scene_keys, tasks)
        blind = [(0.0, jax.vmap(env.task_blind)(keys, tasks))] if name == "controller" else []
        for noise, believed in [*((noise, tasks) for noise in NOISE), *blind]:
            began = time.perf_counter()
            act = functools.partial(perform, env, options=options, noise=noise)
            visited, _ = map_in_chunks(act, (believed, states, keys), 256)
            count = int(judge(env, tasks, visited)[0].sum())
            row = {"split": split, "noise": noise, "task_blind": believed is not tasks, "success": count / scenes}
            row |= {"wilson95": wilson_interval(count, scenes), "seconds": time.perf_counter() - began}
            print(name, row, flush=True)
            found.append(row)
    return found


def main(_: list[str]) -> None:
    """Runs what is missing."""
    folder = pathlib.Path(_OUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    for name in _EXPERTS.value:
        path = folder / f"push-{name}.json"
        if not path.is_file():
            contents = {"expert": name, "scenes": _SCENES.value, "ilqr_iterations": EXPERTS[name]}
            results.write_json(path, contents | {"runs": compare(name, _SCENES.value)} | provenance.describe())


if __name__ == "__main__":
    app.run(main)
