"""Times physics of the push-sized world: substeps in milx and MJX, by JAX and by Warp, `mujoco.rollout`; Jacobians.

python experiments/benchmarks/physics.py
"""

import functools
import os

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # Warp needs memory in the same process

import pathlib

import common
import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
import push_sized
from absl import app, flags
from mujoco import mjx

import milx
from milx.trajopt.linearize import linearize

_OUT = flags.DEFINE_string("out", str(common.RESULTS), "Folder of the JSON file.")
_WORLDS = flags.DEFINE_integer("worlds", None, "Worlds at once; 8,192 on an accelerator and 64 on a CPU by default.")
_POINTS = flags.DEFINE_integer("points", None, "Jacobians at once; 2,048 on an accelerator and 32 on a CPU by default.")


def measure_milx(env: push_sized.PushSized, worlds: int) -> tuple[float, None]:
    """Measures substeps/s of `Env.step`."""
    task = env.sample_task(jax.random.key(0), "train")
    state = jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(jax.random.key(1), worlds), task)
    action = jax.random.uniform(jax.random.key(2), (worlds, env.action_size), minval=-1)
    step = jax.jit(jax.vmap(lambda state, action: env.step(task, state, action)))
    return 1e3 * worlds * env.substeps / common.median_ms(step, state, action), None


def measure_mjx(env: push_sized.PushSized, worlds: int, impl: str) -> tuple[float, None]:
    """Measures substeps/s of `mjx.step`, all of its data carried from step to step."""
    if impl == "warp":
        import warp  # noqa: F401  without it MJX fails later and says less
    model = mjx.put_model(env.mj_model, impl=impl)
    room = {"naconmax": 16 * worlds, "njmax": 64} if impl == "warp" else {}
    task = env.sample_task(jax.random.key(0), "train")

    def start(key: jax.Array, ctrl: jax.Array) -> mjx.Data:
        return mjx.make_data(env.mj_model, impl=impl, **room).replace(qpos=env.reset(key, task).qpos, ctrl=ctrl)

    action = jax.random.uniform(jax.random.key(2), (worlds, env.action_size), minval=-1)
    data = jax.jit(jax.vmap(start))(jax.random.split(jax.random.key(1), worlds), action)
    steps = jax.vmap(mjx.step, in_axes=(None, 0))
    options = {"xla_gpu_graph_min_graph_size": 1} if impl == "warp" else {}
    run = jax.jit(
        lambda data: jax.lax.scan(lambda d, _: (steps(model, d), None), data, length=env.substeps)[0].qpos,
        compiler_options=options,
    )
    return 1e3 * worlds * env.substeps / common.median_ms(run, data), None


def measure_rollout(env: push_sized.PushSized, worlds: int, threads: int) -> tuple[float, None]:
    """Measures substeps/s of C MuJoCo on so many threads."""
    model, steps = env.mj_model, env.substeps
    datas = [mujoco.MjData(model) for _ in range(threads)]
    state = np.zeros((worlds, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    task = env.sample_task(jax.random.key(0), "train")
    keys = jax.random.split(jax.random.key(1), worlds)
    state[:, 1 : 1 + model.nq] = jax.vmap(lambda key: env.reset(key, task).qpos)(keys)
    control = np.random.default_rng(0).uniform(-1, 1, (worlds, 1, model.nu)).repeat(steps, axis=1)
    with mujoco.rollout.Rollout(nthread=threads) as rollout:
        milliseconds = common.median_ms(lambda: rollout.rollout(model, datas, state, control), repeats=5)
    return 1e3 * worlds * steps / milliseconds, None


def measure_jacobians(env: push_sized.PushSized, points: int, how: str) -> tuple[float, float]:
    """Measures Jacobians/s of an action's five substeps, by state and action."""
    task = env.sample_task(jax.random.key(0), "train")
    start = env.reset(jax.random.key(1), task)

    def step(x: jax.Array, u: jax.Array) -> jax.Array:
        return env.step(task, start.with_vector(x), u).vector

    def by_map(x: jax.Array, u: jax.Array) -> jax.Array:
        basis = jnp.eye(x.size + u.size)
        return jax.lax.map(lambda e: jax.jvp(step, (x, u), (e[: x.size], e[x.size :]))[1], basis)

    states = start.vector + 0.01 * jax.random.normal(jax.random.key(2), (points, start.vector.size))
    actions = jax.random.uniform(jax.random.key(3), (points, env.action_size), minval=-1)
    function = (lambda x, u: linearize(step, x, u)) if how == "jacfwd" else jax.vmap(by_map)
    compiled = jax.jit(function).lower(states, actions).compile()
    return 1e3 * points / common.median_ms(compiled, states, actions, repeats=5), common.gib(compiled)


def main(_: list[str]) -> None:
    """Measures and writes the JSON file."""
    milx.configure()
    report, env = common.Report("physics", pathlib.Path(_OUT.value)), push_sized.PushSized()
    accelerated = common.accelerated()
    worlds = _WORLDS.value or (8192 if accelerated else 64)
    points = _POINTS.value or (2048 if accelerated else 32)
    note, unit = f"{worlds} worlds, nv = {env.mj_model.nv}, {env.mj_model.npair} contact pairs, apart", "substeps/s"
    report.measure("milx, JAX", unit, lambda: measure_milx(env, worlds), note)
    report.attempt("milx, Warp", unit, lambda: measure_milx(env.by_warp(), worlds), note)
    report.attempt("MJX, JAX", unit, lambda: measure_mjx(env, worlds, "jax"), note)
    report.attempt("MJX, Warp", unit, lambda: measure_mjx(env, worlds, "warp"), note)
    threads = os.cpu_count() or 1
    report.attempt("mujoco.rollout", unit, lambda: measure_rollout(env, worlds, threads), f"{threads} threads")
    for how in ("jacfwd", "mapped jvp"):
        report.measure(
            f"Jacobians: {how}", "1/s", functools.partial(measure_jacobians, env, points, how), f"{points} at once"
        )


if __name__ == "__main__":
    app.run(main)
