"""How well a network that sees the whole state imitates demonstrations.

    python experiments/planning/imitate.py --env=grasp --tasks=250,500,1000
    python experiments/planning/imitate.py --env=push --expert=sampling --batch=512 --tasks=769
    python experiments/planning/imitate.py --env=reach --preset=cpu --tasks=100 --steps=500   # on two cores

The network is told the state, the places of what stands still, and the residuals of the environment's cost, which tell
the target, and once the time step, too. It learns the actions of the first so many training tasks by least squares.
Where the time helps, the demonstrations depend on it, and a policy of images and states, which does not know it, cannot
imitate them. Demonstrations are those of a run of the preset with as many tasks as the largest number, from the cache
where they are, and validation tasks are those of all runs.
"""

import dataclasses
import functools
import pathlib
import time
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from absl import app, flags
from demonstrate import ITERATIONS

import milx
from milx import envs
from milx.config.assemble import make_config
from milx.core import files
from milx.data.simulated import DemoSet
from milx.envs.base import Env, State, Task
from milx.evaluation import provenance
from milx.evaluation.closed_loop import trial_scenes
from milx.evaluation.intervals import wilson_interval
from milx.methods.whitening import Whitening
from milx.methods.whitening import fit as fit_whitening
from milx.training.simulated import demos_of_split, trial_key
from milx.types import Params

BATCH, WIDTH, RATE = 1024, 256, 2e-3


class Network(nn.Module):
    """Three hidden layers."""

    outputs: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps whitened features [..., F] to whitened actions [..., A]."""
        for _ in range(3):
            x = nn.gelu(nn.Dense(WIDTH)(x))
        return nn.Dense(self.outputs)(x)


class Imitator(NamedTuple):
    """A network that has learned.

    Attributes:
        whitening: of features and actions, as of states and actions.
        params: of the network, for whitened features and actions.
    """

    whitening: Whitening
    params: Params

    def whitened(self, features: jax.Array) -> jax.Array:
        """Returns the whitened actions [..., A] for features [..., F]."""
        network = Network(len(self.whitening.action_mean))
        return jnp.asarray(network.apply(self.params, self.whitening.state(features)))

    def action(self, features: jax.Array) -> jax.Array:
        """Returns the actions [..., A] for features [..., F]."""
        return self.whitening.unwhiten_action(self.whitened(features))


def observe(env: Env, timed: bool, task: Task, state: State, t: jax.Array) -> jax.Array:
    """Returns what the network sees: state, places, residuals without an action at time 0, and the time step."""
    residual = env.running_residual(task, state, jnp.zeros(env.action_size), jnp.int32(0))
    seen = [state.vector, state.mocap_pos.ravel(), residual]
    return jnp.concatenate([*seen, t[None]] if timed else seen)


@functools.partial(jax.jit, static_argnums=(0, 1))
def examples(env: Env, timed: bool, demos: DemoSet) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns features [M, F] and actions [M, A] of all time steps, and [M] whether their demonstration succeeds."""
    before = jax.tree.map(lambda x: x[:, :, :-1], demos.states)
    see = jax.vmap(functools.partial(observe, env, timed), in_axes=(None, 0, 0))
    times = jnp.arange(env.horizon, dtype=float)
    seen = jax.vmap(jax.vmap(see, in_axes=(None, 0, None)), in_axes=(0, 0, None))(demos.task, before, times)
    counts = jnp.broadcast_to(demos.success[..., None], demos.action.shape[:-1])
    return seen.reshape(-1, seen.shape[-1]), demos.action.reshape(-1, env.action_size), counts.ravel()


@functools.partial(jax.jit, static_argnums=2)
def fit(features: jax.Array, actions: jax.Array, steps: int, seed: int) -> Imitator:
    """Minimizes the mean squared error of the whitened actions by AdamW with a cosine."""
    init_key, draw_key = jax.random.split(jax.random.key(seed))
    optimizer = optax.adamw(optax.cosine_decay_schedule(RATE, steps), weight_decay=1e-4)
    whitening = fit_whitening(features, actions, whiten_actions=True)
    params = dict(Network(actions.shape[1]).init(init_key, features[0]))

    def loss(params: Params, rows: jax.Array) -> jax.Array:
        found = Imitator(whitening, params).whitened(features[rows])
        return jnp.square(found - whitening.action(actions[rows])).mean()

    def update(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
        params, state = carry
        gradient = jax.grad(loss)(params, jax.random.randint(key, (BATCH,), 0, len(features)))
        change, state = optimizer.update(gradient, state, params)
        return (optax.apply_updates(params, change), state), None

    (params, _), _ = jax.lax.scan(update, (params, optimizer.init(params)), jax.random.split(draw_key, steps))
    return Imitator(whitening, params)


@functools.partial(jax.jit, static_argnums=(0, 1))
def attempt(env: Env, timed: bool, imitator: Imitator, task: Task, scenes: State) -> jax.Array:
    """Acts in the scenes [N, trials] of N tasks and returns [N, trials], whether it succeeds."""

    def trial(task: Task, scene: State) -> jax.Array:
        def step(state: State, t: jax.Array) -> tuple[State, State]:
            after = env.step(task, state, imitator.action(observe(env, timed, task, state, t)))
            return after, after

        _, visited = jax.lax.scan(step, scene, jnp.arange(env.horizon, dtype=float))
        return env.success(task, jax.tree.map(lambda x, rest: jnp.concatenate([x[None], rest]), scene, visited))

    return jax.vmap(jax.vmap(trial, in_axes=(None, 0)))(task, scenes)


def measure(env: Env, timed: bool, train: DemoSet, validation: DemoSet, trials: int, steps: int, seed: int) -> dict:
    """Learns from `train`, and returns success in trials and what is left of the variance of each action."""
    features, actions, counts = examples(env, timed, train)
    imitator = fit(features[counts], actions[counts], steps, seed)
    features, actions, counts = examples(env, timed, validation)
    off = jnp.square(imitator.action(features) - actions)[counts].mean(axis=0)
    scenes = trial_scenes(env, validation.task, trial_key("validation"), trials)
    success = attempt(env, timed, imitator, validation.task, scenes)
    return {
        "demonstrations": int(train.success.sum()),
        "unexplained": (off / actions[counts].var(axis=0)).tolist(),
        "trials": success.size,
        "success": float(success.mean()),
        "wilson95": wilson_interval(int(success.sum()), success.size),
    }


def main(_: list[str]) -> None:
    """Measures for each number of tasks, with and without the time, and writes a file."""
    milx.configure()
    origin, began = provenance.origin(), time.perf_counter()
    config, tasks = make_config(_ENV.value, preset=_PRESET.value), [int(count) for count in _TASKS.value]
    config.data.tasks = max(tasks)
    if _EXPERT.value:
        config.data.expert = _EXPERT.value
        config.data.plan_iterations = ITERATIONS[_EXPERT.value]
    if _BATCH.value:
        config.data.plan_batch = _BATCH.value
    env = envs.of_config(config)
    train, validation = (demos_of_split(env, config, split) for split in ("train", "validation"))
    planned, rows = time.perf_counter() - began, []
    for count in tasks:
        part = jax.tree.map(lambda x, count=count: x[:count], train)
        for timed in (False, True):
            found = measure(env, timed, part, validation, _TRIALS.value, _STEPS.value, config.seed)
            rows.append({"tasks": count, "time": timed, **found})
            print(f"{count} tasks{', and the time' if timed else ''}: {found['success']:.1%} succeed", flush=True)
    said: dict[str, Any] = {"env": _ENV.value, "preset": _PRESET.value, "seed": config.seed, "steps": _STEPS.value}
    said["data"] = dataclasses.asdict(config.data)
    seconds = {"demonstrations": planned, "total": time.perf_counter() - began}
    result = {**said, "validation": float(validation.success.mean()), "rows": rows, "seconds": seconds, **origin}
    folder = pathlib.Path(_OUT.value)
    folder.mkdir(parents=True, exist_ok=True)
    files.write_json(folder / f"imitate-{_ENV.value}-{_PRESET.value}-{_EXPERT.value or 'own'}.json", result)


if __name__ == "__main__":
    _ENV = flags.DEFINE_enum("env", "grasp", list(envs.ENVS), "Which environment.")
    _PRESET = flags.DEFINE_string("preset", "fast", "Whose demonstrations.")
    _EXPERT = flags.DEFINE_enum("expert", None, list(ITERATIONS), "Who demonstrates; default the preset's.")
    _BATCH = flags.DEFINE_integer("batch", None, "Demonstrations planned at once; default the preset's.", lower_bound=1)
    _TASKS = flags.DEFINE_list("tasks", ["250", "500", "1000"], "Numbers of training tasks to learn from.")
    _TRIALS = flags.DEFINE_integer("trials", 4, "Trials of each validation task.", lower_bound=1)
    _STEPS = flags.DEFINE_integer("steps", 4000, "Updates of the network.", lower_bound=1)
    _OUT = flags.DEFINE_string("out", "experiments/results/planning", "Folder of the JSON file.")
    app.run(main)
