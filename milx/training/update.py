"""Meta-training: everything between two log lines is one scan on the device.

Sampling, rendering, inner step, meta-gradient and the optimizer's step all happen inside the scan. Batches are
functions of the seed and the step, so a run that is stopped and started again repeats the uninterrupted run from its
last checkpoint.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import optax.contrib

from milx import meta
from milx.config.schema import OPTIMIZERS, OptimizerConfig, TrainConfig
from milx.core import parallel, platform
from milx.evaluation import listening
from milx.methods.base import Method
from milx.methods.whitening import Whitening
from milx.types import Array, Params, TaskBatch

Sample = Callable[[Any, jax.Array], TaskBatch]
"""Draws a batch from demonstrations, a task for each of the keys [N]; called inside `jax.jit`."""

_CPU_IMAGES = 100
"""Images of a meta-batch that a CPU works on at once; at least one task's. With 500 of 80x64 each takes longer."""

_MUON_RMS = 0.4
"""Root mean square of the step of a kernel, in learning rates; Adam's is 0.2 to 0.4 (Liu et al. 2025, Section 2.2)."""


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
    """Makes the optimizer with its schedule over `steps` meta-updates, after clipping the global norm.

    Raises:
        ValueError: for an optimizer that does not exist.
    """
    if config.name not in OPTIMIZERS:
        raise ValueError(f"optimizer.name: got {config.name!r}, expected one of {', '.join(OPTIMIZERS)}")
    peak, warmup = config.learning_rate, round(config.warmup * steps)
    then = optax.cosine_decay_schedule(peak, steps - warmup) if config.cosine else optax.constant_schedule(peak)
    rate = optax.join_schedules([optax.linear_schedule(0.0, peak, max(warmup, 1)), then], [warmup])
    clip = optax.identity() if config.clip_norm is None else optax.clip_by_global_norm(config.clip_norm)
    if config.name == "adam":
        return optax.chain(clip, optax.adam(rate))
    # Learned rates of the inner step are scalars, and biases vectors, which have no orthogonal matrix near them.
    return optax.chain(clip, optax.contrib.muon(rate, muon_weight_dimension_numbers=_kernels, consistent_rms=_MUON_RMS))


def _kernels(params: Params) -> Any:
    """Tells Muon how to read a kernel [..., F] as a matrix with F columns; None for all other parameters."""

    def read(path: tuple, x: jax.Array) -> optax.contrib.MuonDimensionNumbers | None:
        if x.ndim < 2 or getattr(path[-1], "key", None) != "kernel":
            return None
        return optax.contrib.MuonDimensionNumbers(tuple(range(x.ndim - 1)), (x.ndim - 1,))

    return jax.tree_util.tree_map_with_path(read, params)


Loss = Callable[[Params, TaskBatch], tuple[jax.Array, dict[str, jax.Array]]]
"""As `Method.loss`: the mean over a batch of N tasks, and metrics [N]."""


def batch_gradient(loss: Loss, params: Params, batch: TaskBatch) -> tuple[Params, dict[str, jax.Array]]:
    """Computes the gradient of a method's loss, and its metrics.

    A CPU works on a few tasks at a time (`meta.meta_gradient`), so that what they need stays in its cache.

    Args:
        loss: of a batch of tasks, say `method.loss`.
        params: what it is differentiated by.
        batch: N tasks; all leaves have this leading axis.

    Returns:
        The gradient of the mean over the tasks, as `params`, and the metrics, [N] each.
    """
    shown = jax.tree.leaves((batch.support.image, batch.query.image))
    images = sum(x.shape[1] * x.shape[2] for x in shown)  # of each task
    if jax.default_backend() != "cpu" or images * len(batch.query.action) <= _CPU_IMAGES:
        return jax.grad(loss, has_aux=True)(params, batch)

    def task_loss(params: Params, task: TaskBatch) -> tuple[jax.Array, dict[str, jax.Array]]:
        return loss(params, jax.tree.map(lambda x: x[None], task))

    gradient, (_, metrics) = meta.meta_gradient(task_loss, params, batch, max(_CPU_IMAGES // images, 1), has_aux=True)
    return gradient, jax.tree.map(jnp.ravel, metrics)


@dataclasses.dataclass(frozen=True, eq=False)
class Trainer:
    """The meta-training loop's jitted part.

    Attributes:
        sample: draws batches from what `run` is given as `data`.
        method: what learns.
        train: batch sizes and length.
        optimizer: the meta-optimizer.
    """

    sample: Sample
    method: Method
    train: TrainConfig
    optimizer: optax.GradientTransformation

    @functools.partial(jax.jit, static_argnums=0)
    def init(self, key: jax.Array, whitening: Whitening) -> TrainState:
        """Makes the state before the first meta-update."""
        params = self.method.init(key, whitening)
        return TrainState(jnp.zeros((), jnp.int32), params, self.optimizer.init(params))

    def update(self, state: TrainState, data: Any, key: jax.Array) -> tuple[TrainState, dict[str, jax.Array]]:
        """Makes one meta-update on the batch of (key, state.step), unless its loss or its gradient is not finite.

        Returns:
            The next state, and the metrics' means over the tasks; "skipped" is 1 where the parameters stayed as they
            were and the other metrics are 0, and "bad_task" the number of a task whose loss is not finite, else -1.
        """

        def gradient(
            params: Params, data: Any, step: jax.Array, keys: jax.Array
        ) -> tuple[Params, dict[str, jax.Array]]:
            batch = self._batch(data, keys)
            grad, metrics = self._gradient(params, batch, step)
            task = jnp.zeros_like(metrics["loss"]) if batch.task is None else batch.task.astype(metrics["loss"].dtype)
            bad = parallel.largest(jnp.where(jnp.isfinite(metrics["loss"]), -1, task).max())
            return grad, {**jax.tree.map(jnp.mean, metrics), "bad_task": bad}

        split = parallel.shard_tasks(gradient, shared=3, average=True)
        grad, metrics = split(state.params, data, state.step, self._keys(key, state.step))
        metrics["grad_norm"] = optax.tree.norm(grad)
        good = jnp.isfinite(metrics["grad_norm"]) & jnp.isfinite(metrics["loss"])
        updates, optimizer = self.optimizer.update(grad, state.optimizer, state.params)
        updated = optax.apply_updates(state.params, updates), optimizer
        keep = lambda new, old: jnp.where(good, new, old)  # noqa: E731
        params, optimizer = jax.tree.map(keep, updated, (state.params, state.optimizer))
        bad_task = metrics.pop("bad_task")
        metrics = {name: jnp.where(good, value, 0) for name, value in metrics.items()}
        metrics |= {"skipped": 1 - good.astype(jnp.float32), "bad_task": bad_task}
        return TrainState(state.step + 1, params, optimizer), metrics

    def _keys(self, key: jax.Array, step: jax.Array) -> jax.Array:
        """Splits the keys [N] that draw the batch of a step."""
        return jax.random.split(jax.random.fold_in(key, step), self.train.meta_batch)

    @functools.partial(jax.jit, static_argnums=0)  # so that `run`, which draws twice, traces it once
    def _batch(self, data: Any, keys: jax.Array) -> TaskBatch:
        return self.sample(data, keys)

    def _gradient(self, params: Params, batch: TaskBatch, step: jax.Array) -> tuple[Params, dict[str, jax.Array]]:
        """Computes the gradient of plain imitation for the first updates, if configured, then of the meta-objective."""
        first = self.method.imitation_steps

        def meta_objective(params: Params, batch: TaskBatch) -> tuple[jax.Array, dict[str, jax.Array]]:
            return self.method.loss(params, batch, jnp.maximum(step - first, 0) / (self.train.steps - first))

        if not first:
            return batch_gradient(meta_objective, params, batch)
        losses = self.method.imitation, meta_objective
        branches = [functools.partial(batch_gradient, loss) for loss in losses]
        return jax.lax.cond(step < first, *branches, params, batch)

    @functools.partial(jax.jit, static_argnums=(0, 4))
    def run(self, state: TrainState, data: Any, key: jax.Array, steps: int) -> tuple[TrainState, dict[str, jax.Array]]:
        """Runs `steps` meta-updates in one scan.

        Returns:
            The state, and the metrics' means over the updates that were not skipped; "skipped" is how many were, and
            "bad_task" the largest. What `listening.measure` finds is of the last parameters and the batch that comes
            next.
        """
        state, metrics = jax.lax.scan(lambda s, _: self.update(s, data, key), state, length=steps)
        skipped, bad_task = metrics.pop("skipped").sum(), metrics.pop("bad_task").max()
        means = {name: value.sum() / jnp.maximum(steps - skipped, 1) for name, value in metrics.items()}
        batch = parallel.shard_tasks(self._batch, shared=1)(data, self._keys(key, state.step))
        return state, {
            **means,
            **listening.measure(self.method, state.params, batch),
            "skipped": skipped,
            "bad_task": bad_task,
        }


def compile_in_background(
    trainer: Trainer, params: Params, data: Any, steps: int, then: Iterable[Callable[[], None]]
) -> list[Future[Any]]:
    """Compiles `Trainer.run` from shapes alone while the caller does something else, then calls each of `then`.

    One after the other: tracing holds Python's lock, so that more threads would slow the caller's tracing down.

    Args:
        trainer: what is to run.
        params: shapes of the method's parameters.
        data: shapes of what `run` draws its batches from.
        steps: meta-updates of a scan.
        then: functions that compile other programs.

    Returns:
        The future program, a function of a state, data and a key, and the futures of `then`, which hold nothing.
    """
    optimizer = jax.eval_shape(trainer.optimizer.init, params)
    state = TrainState(jax.ShapeDtypeStruct((), np.int32), params, optimizer)

    def compile_run() -> Callable[..., Any]:
        lowered = Trainer.run.lower(trainer, state, data, jax.random.key(0), steps)
        return lowered.compile(platform.pixel_options())

    thread = ThreadPoolExecutor(max_workers=1)
    futures = [thread.submit(function) for function in (compile_run, *then)]
    thread.shutdown(wait=False)
    return futures
