"""Inputs of the right sizes and no meaning, and the training step on them."""

from typing import Any

import common
import jax
import jax.numpy as jnp
from jax.sharding import NamedSharding, PartitionSpec

from milx import methods
from milx.config.schema import Config
from milx.core import parallel, platform
from milx.data.simulated import DemoSet, sampler
from milx.envs.base import Env, State
from milx.methods.whitening import Whitening
from milx.training.update import Trainer, make_optimizer
from milx.types import Demo, TaskBatch


def random_batch(env: Env, tasks: int, frames: int) -> TaskBatch:
    """Samples images, states, actions and goals without meaning."""

    def demo(key: jax.Array) -> Demo:
        keys = jax.random.split(key, 3)
        image = jax.random.randint(keys[0], (tasks, 1, frames, *env.image_shape, 3), 0, 256).astype(jnp.uint8)
        state = jax.random.normal(keys[1], (tasks, 1, frames, env.state_size))
        action = jax.random.uniform(keys[2], (tasks, 1, frames, env.action_size), minval=-1)
        return Demo(image, state, action, goal=state[..., jnp.array(env.goal_indices)])

    return TaskBatch(*(demo(key) for key in jax.random.split(jax.random.key(0))))


def unit_whitening(env: Env) -> Whitening:
    """Makes whitening that changes nothing."""
    return Whitening(*(fill(n) for n in (env.state_size, env.action_size) for fill in (jnp.zeros, jnp.ones)))


def random_demos(env: Env, num_tasks: int, num_demos: int) -> DemoSet:
    """Samples demonstrations of the right size: random poses, random actions."""
    keys = jax.random.split(jax.random.key(0), 3)
    tasks = jax.vmap(env.sample_task, in_axes=(0, None))(jax.random.split(keys[0], num_tasks), "train")

    def one(key: jax.Array, task: Any) -> State:
        return jax.vmap(env.reset, in_axes=(0, None))(jax.random.split(key, env.horizon + 1), task)

    states = jax.vmap(jax.vmap(one, in_axes=(0, None)))(jax.random.split(keys[1], (num_tasks, num_demos)), tasks)
    action = jax.random.uniform(keys[2], (num_tasks, num_demos, env.horizon, env.action_size), minval=-1)
    return DemoSet(tasks, states, action, jnp.ones((num_tasks, num_demos), bool))


def measure_step(config: Config, env: Env) -> tuple[float, float]:
    """Measures the median ms of a training step with rendering, in a scan on the mesh's devices, and GiB on each."""
    trainer = Trainer(
        sampler(env, config.train),
        methods.make(config, env.spec),
        config.train,
        make_optimizer(config.optimizer, 100),
    )
    inputs = trainer.init(jax.random.key(0), unit_whitening(env)), random_demos(env, 64, 4), jax.random.key(1)
    inputs = jax.device_put(inputs, NamedSharding(parallel.mesh(), PartitionSpec()))
    steps = 20 if common.accelerated() else 2
    compiled = Trainer.run.lower(trainer, *inputs, steps).compile(platform.pixel_options())
    return common.median_ms(compiled, *inputs, repeats=5) / steps, common.gib(compiled)
