"""Meta-training: everything between two log lines is one scan on the device.

Sampling, rendering, inner step, meta-gradient and Adam all happen inside the scan. Batches are functions of the seed
and the step, so a run that is stopped and started again repeats the uninterrupted run from its last checkpoint.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax

from milx import parallel
from milx.config import OptimizerConfig, TrainConfig
from milx.data.demos import DemoSet, sample_batch
from milx.envs.base import Env
from milx.methods.base import Method
from milx.types import Array, Params
from milx.whitening import Whitening


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class TrainState:
    """What changes from one meta-update to the next.

    Attributes:
        step: int32, meta-updates done.
        params: what the method learns.
        optimizer: the optimizer's own state.
    """

    step: Array
    params: Params
    optimizer: Any


def make_optimizer(config: OptimizerConfig, steps: int) -> optax.GradientTransformation:
    """Adam with the configured schedule over `steps` meta-updates, after clipping the global norm."""
    peak, warmup = config.learning_rate, round(config.warmup * steps)
    then = optax.cosine_decay_schedule(peak, steps - warmup) if config.cosine else optax.constant_schedule(peak)
    rate = optax.join_schedules([optax.linear_schedule(0.0, peak, max(warmup, 1)), then], [warmup])
    clip = optax.identity() if config.clip_norm is None else optax.clip_by_global_norm(config.clip_norm)
    return optax.chain(clip, optax.adam(rate))


@dataclasses.dataclass(frozen=True, eq=False)
class Trainer:
    """The meta-training loop's jitted part.

    Attributes:
        env: renders the demonstrations.
        method: what learns.
        train: batch sizes and length.
        optimizer: the meta-optimizer.
    """

    env: Env
    method: Method
    train: TrainConfig
    optimizer: optax.GradientTransformation

    @functools.partial(jax.jit, static_argnums=0)
    def init(self, key: jax.Array, whitening: Whitening) -> TrainState:
        """The state before the first meta-update."""
        params = self.method.init(key, whitening)
        return TrainState(jnp.zeros((), jnp.int32), params, self.optimizer.init(params))

    def update(self, state: TrainState, demos: DemoSet, key: jax.Array) -> tuple[TrainState, dict[str, jax.Array]]:
        """One meta-update on the batch of (key, state.step)."""

        def gradient(params: Params, demos: DemoSet, keys: jax.Array) -> tuple[Params, dict[str, jax.Array]]:
            train = self.train
            frames = train.support_frames, train.query_frames
            batch = sample_batch(self.env, demos, keys, train.shots, *frames, train.redraw)
            (loss, metrics), grad = jax.value_and_grad(self.method.loss, has_aux=True)(params, batch)
            return grad, {"loss": loss, **metrics}

        keys = jax.random.split(jax.random.fold_in(key, state.step), self.train.meta_batch)
        grad, metrics = parallel.split_tasks(gradient, shared=2, average=True)(state.params, demos, keys)
        updates, optimizer = self.optimizer.update(grad, state.optimizer, state.params)
        params = optax.apply_updates(state.params, updates)
        metrics["grad_norm"] = optax.global_norm(grad)
        return TrainState(state.step + 1, params, optimizer), metrics

    @functools.partial(jax.jit, static_argnums=(0, 4))
    def run(
        self, state: TrainState, demos: DemoSet, key: jax.Array, steps: int
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        """Runs `steps` meta-updates in one scan; returns the state and the metrics' means."""
        state, metrics = jax.lax.scan(lambda s, _: self.update(s, demos, key), state, length=steps)
        return state, jax.tree.map(jnp.mean, metrics)
