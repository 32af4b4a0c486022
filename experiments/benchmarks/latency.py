"""Times what a user waits for: adapting, acting, evaluating, planning, compiling.

    python experiments/benchmarks/latency.py

Vision reach with the paper's network and with that of the `fast` preset, random parameters.
"""

import pathlib
import tempfile
import time

import common
import jax
import push_sized
import workload
from absl import app, flags
from jax.experimental.compilation_cache import compilation_cache

import milx
from milx import envs, methods
from milx.config.assemble import make_config
from milx.config.schema import Config
from milx.core import platform
from milx.data.simulated import sampler
from milx.deploy.policy import Policy
from milx.envs.base import Env
from milx.evaluation import closed_loop
from milx.training.update import Trainer, make_optimizer
from milx.trajopt.expert import Planned
from milx.trajopt.ilqr import Options
from milx.types import Observation

_OUT = flags.DEFINE_string("out", str(common.RESULTS), "Folder of the JSON file.")
_TASKS = flags.DEFINE_integer(
    "tasks", None, "Tasks of the evaluation, ten trials each; 150, or 15 on a CPU, by default."
)
_PLANS = flags.DEFINE_integer("plans", None, "Demonstrations planned at once; 4,096, or 50 on a CPU, by default.")


def measure_policy(name: str, config: Config, env: Env, report: common.Report) -> None:
    """Rows of one policy's adaptation to one demonstration, and of one action."""
    spec = env.spec
    method = methods.make(config, spec)
    policy = Policy(method, spec, method.init(jax.random.key(0), workload.unit_whitening(env)), config)
    demo = jax.tree.map(lambda x: x[0, 0], workload.random_batch(env, 1, env.horizon).support)
    seen = Observation(image=demo.image[0], state=demo.state[0])
    report.add(f"{name}: adapt to one demonstration", common.median_ms(policy.adapt, policy.params, demo), "ms")
    task_params = policy.adapt(policy.params, demo)
    report.add(f"{name}: act once", common.median_ms(policy.act, task_params, seen), "ms")


def measure_evaluation(config: Config, env: Env, report: common.Report) -> None:
    """Adds the row of the closed-loop evaluation: adaptation included, demonstrations given."""
    method = methods.make(config, env.spec)
    params = method.init(jax.random.key(0), workload.unit_whitening(env))
    tasks = _TASKS.value or (150 if common.accelerated() else 15)
    demos = workload.random_demos(env, tasks, 1)
    config.evaluation.batch = tasks
    milliseconds = common.median_ms(
        lambda: closed_loop.run_trials(env, method, params, demos, config.evaluation, jax.random.key(0)), repeats=5
    )
    trials = tasks * config.evaluation.trials
    report.add(f"{trials:,} closed-loop trials of {env.horizon} steps", 1e-3 * milliseconds, "s")


def measure_planning(env: Env, report: common.Report) -> None:
    """Adds the row of demonstrations planned and performed."""
    count = _PLANS.value or (50 if not common.accelerated() else 4096)
    keys = jax.random.split(jax.random.key(0), count)
    task = jax.vmap(env.sample_task, in_axes=(0, None))(keys, "train")
    state = jax.vmap(env.reset)(keys, task)
    expert = Planned(Options(iterations=16))
    milliseconds = common.median_ms(lambda: expert.perform(env, task, state, keys, 0.01), repeats=3)
    report.add("demonstrations planned", 1e3 * count / milliseconds, "1/s", note=f"{count} at once")


def measure_compilation(config: Config, env: Env, report: common.Report) -> None:
    """Rows of compiling the training scan: without a cache, and from it."""
    trainer = Trainer(
        sampler(env, config.train),
        methods.make(config, env.spec),
        config.train,
        make_optimizer(config.optimizer, 100),
    )
    state, demos = trainer.init(jax.random.key(0), workload.unit_whitening(env)), workload.random_demos(env, 8, 4)
    with tempfile.TemporaryDirectory() as folder:
        jax.config.update("jax_compilation_cache_dir", folder)
        for name in ("without a cache", "from the cache"):
            jax.clear_caches()
            compilation_cache.reset_cache()  # JAX would go on with the folder it used first
            began = time.perf_counter()
            Trainer.run.lower(trainer, state, demos, jax.random.key(1), 100).compile(platform.pixel_options())
            report.add(f"tracing and compiling the training scan, {name}", time.perf_counter() - began, "s")


def main(_: list[str]) -> None:
    """Measures and writes the JSON file."""
    milx.configure()
    report, env = common.Report("latency", pathlib.Path(_OUT.value)), envs.make("reach")
    fast = make_config("reach", preset="fast")
    measure_policy("reach, paper's network", make_config("reach", preset="paper"), env, report)
    measure_policy("reach, fast preset", fast, env, report)
    measure_policy("push, paper's network", push_sized.config(), push_sized.PushSized(), report)
    measure_evaluation(fast, env, report)
    measure_planning(env, report)
    measure_compilation(fast, env, report)


if __name__ == "__main__":
    app.run(main)
