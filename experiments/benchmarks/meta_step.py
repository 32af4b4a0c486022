"""Times a meta-gradient of the paper's sizes, push and reach, in milx and in what a user would write instead.

    python experiments/benchmarks/meta_step.py --out=experiments/results/benchmarks

All work on the same random images. Peers: vmap over `lax.conv`, PyTorch (if it is installed) with a loop over tasks,
with torch.func and with torch.compile. A roofline says how far from the hardware's limit that is.
"""

import os

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # PyTorch needs memory in the same process

import dataclasses
import functools
import pathlib
from collections.abc import Callable
from typing import Any

import common
import jax
import jax.numpy as jnp
import push_sized
import workload
from absl import app, flags

import milx
from milx import envs, methods
from milx.config.assemble import make_config
from milx.config.schema import Config
from milx.core import platform
from milx.envs.base import Env
from milx.methods.mil import MILConfig
from milx.networks import layers
from milx.networks.policy_network import PolicyConfig
from milx.training.update import Loss, batch_gradient
from milx.types import Params, TaskBatch

_OUT = flags.DEFINE_string("out", str(common.RESULTS), "Folder of the JSON file.")
_TASKS = flags.DEFINE_integer("tasks", None, "Tasks in a meta-batch; the paper's by default.")
_FRAMES = flags.DEFINE_integer("frames", None, "Time steps of a demonstration; all by default.")
_DOMAINS = flags.DEFINE_list("domains", None, "Which sizes; reach and push, or reach on a CPU, by default.")


def domain(name: str) -> tuple[Config, Env]:
    """Makes the configuration and the environment of the paper's experiment."""
    if name == "push":
        return push_sized.config(), push_sized.PushSized()
    config = make_config("reach", preset="paper")
    config.train.meta_batch = 5
    assert isinstance(config.method, MILConfig)
    config.method.imitation_steps = 0  # or the first steps, which are measured, would have no inner step
    return config, envs.make("reach")


def plain_norm_relu(x: jax.Array, bias: jax.Array, center: jax.Array, dtype: jnp.dtype) -> jax.Array:
    """Computes `layers.norm_relu` as one would write it first."""
    return jax.nn.relu(layers.biased_norm(x, bias, center)).astype(dtype)


def compile_gradient(
    config: Config, env: Env, batch: TaskBatch, gradient: Callable[..., Any] = batch_gradient
) -> tuple[jax.stages.Compiled, Any]:
    """Compiles the meta-gradient, and makes parameters for it."""
    method = methods.make(config, env.spec)
    params = method.init(jax.random.key(0), workload.unit_whitening(env))
    jitted = jax.jit(functools.partial(gradient, method.loss))
    return jitted.lower(params, batch).compile(platform.pixel_options()), params


def vmapped_gradient(loss: Loss, params: Params, batch: TaskBatch) -> Params:
    """Computes the meta-gradient of all tasks at once, on a CPU too."""
    return jax.grad(loss, has_aux=True)(params, batch)[0]


def floor_ms(config: Config, env: Env, tasks: int, frames: int) -> tuple[float, str]:
    """Estimates the least time of a meta-gradient: operations and bytes over ceilings that are measured here.

    Convolutions in bfloat16, or float32 on a CPU; fully connected layers are left out. A forward pass counts 1, a
    backward pass 2 (1 for the first layer, which needs no gradient of the image); the support demonstration takes one
    of each, and twice that again for the Hessian-vector product; the query one of each. Every pass reads its inputs and
    writes its outputs.
    """
    assert isinstance(config.network, PolicyConfig)
    n, kind, copies = (8192, jnp.bfloat16, 2**28) if common.accelerated() else (2048, jnp.float32, 2**26)
    a = jax.random.normal(jax.random.key(0), (n, n), kind)
    product = jax.jit(lambda a: a @ a)
    operations_per_s = 2 * n**3 / (1e-3 * common.median_ms(product, a, repeats=10))
    copied = jnp.zeros(copies)
    bytes_per_s = 2 * copied.nbytes / (1e-3 * common.median_ms(jax.jit(lambda x: x + 1), copied, repeats=10))

    operations = traffic = 0.0
    (height, width), channels = env.image_shape, 3
    for i, (filters, stride) in enumerate(zip(config.network.filters, config.network.strides, strict=True)):
        inputs = height * width * channels
        height, width = -(-height // stride), -(-width // stride)
        outputs = height * width * filters
        products = 2 * outputs * channels * config.network.kernel**2
        passes = (1 + (2 if i else 1)) * (1 + 2 + 1)
        operations += passes * products
        traffic += passes * (a.itemsize if i else 1) * inputs + passes * a.itemsize * outputs
        channels = filters
    count = tasks * frames
    by_operations, by_bytes = 1e3 * count * operations / operations_per_s, 1e3 * count * traffic / bytes_per_s
    note = (
        f"{count * operations / 1e9:.0f} GFLOP at {operations_per_s / 1e12:.3g} TFLOP/s: {by_operations:.3g} ms; "
        f"{count * traffic / 1e9:.1f} GB at {bytes_per_s / 1e12:.3g} TB/s: {by_bytes:.3g} ms"
    )
    return max(by_operations, by_bytes), note


def measure_torch(config: Config, env: Env, batch: TaskBatch, mode: str, bf16: bool) -> tuple[float, float]:
    """Measures the median ms and the peak GiB of the PyTorch peer."""
    import torch
    import torch_peer

    if not torch.cuda.is_available():
        raise RuntimeError("PyTorch sees no GPU")

    def tensor(get) -> Any:
        both = jnp.stack([get(batch.support)[:, 0], get(batch.query)[:, 0]], axis=1)
        return torch.utils.dlpack.from_dlpack(both)

    data = [tensor(lambda demo: demo.image), tensor(lambda demo: demo.state), tensor(lambda demo: demo.action)]
    torch.manual_seed(0)
    params = torch_peer.make_params(config, env.image_shape, env.state_size, env.action_size)
    step = torch_peer.make_step(config, mode, bf16)
    for _ in range(3):
        step(params, *data)
    torch.cuda.reset_peak_memory_stats()
    milliseconds = common.median_ms(step, params, *data, wait=lambda _: torch.cuda.synchronize())
    memory = torch.cuda.max_memory_allocated() / 2**30
    torch.cuda.empty_cache()
    return milliseconds, memory


def measure_domain(name: str) -> None:
    """Writes all rows of one experiment's sizes."""
    report = common.Report(f"meta_step-{name}", pathlib.Path(_OUT.value))
    config, env = domain(name)
    tasks, frames = _TASKS.value or config.train.meta_batch, _FRAMES.value or env.horizon
    config.train.meta_batch, config.train.support_frames, config.train.query_frames = tasks, frames, frames
    batch = workload.random_batch(env, tasks, frames)
    sizes = f"{tasks} tasks x 2 x {frames} frames of {env.image_shape[1]}x{env.image_shape[0]}"
    repeats = 20 if common.accelerated() else 3

    def variant(mixed: bool, rematerialise: bool = False) -> Config:
        assert isinstance(config.network, PolicyConfig)
        network = dataclasses.replace(config.network, mixed_precision=mixed, rematerialise=rematerialise)
        return dataclasses.replace(config, network=network)

    def gradient(*changes: bool, by: Callable[..., Any] = batch_gradient) -> tuple[float, float]:
        compiled, params = compile_gradient(variant(*changes), env, batch, by)
        return common.median_ms(compiled, params, batch, repeats=repeats), common.gib(compiled)

    accelerated = common.accelerated()
    for mixed in (True, False) if accelerated else (False,):
        kind = "bfloat16" if mixed else "float32"
        report.measure(f"milx, {kind}", "ms", functools.partial(gradient, mixed), f"{sizes}, called one by one")
        report.measure(
            f"whole step with rendering: milx, {kind}",
            "ms",
            functools.partial(workload.measure_step, variant(mixed), env),
            "in a scan",
        )
    report.measure("milx, rematerialised", "ms", lambda: gradient(accelerated, True))
    ours = layers.conv2d, layers.norm_relu
    layers.conv2d, layers.norm_relu = common.lax_convolution, plain_norm_relu
    for mixed in (True, False) if accelerated else (False,):
        kind = "bfloat16" if mixed else "float32"
        report.attempt(
            f"JAX, vmap over lax.conv, {kind}", "ms", functools.partial(gradient, mixed, by=vmapped_gradient)
        )
    layers.conv2d, layers.norm_relu = ours
    for mode, bf16 in (("loop", False), ("vmap", False), ("vmap", True), ("compile", False), ("compile", True)):
        kind = "bfloat16" if bf16 else "float32"
        report.attempt(
            f"PyTorch, {mode}, {kind}", "ms", functools.partial(measure_torch, config, env, batch, mode, bf16)
        )
    least, note = floor_ms(config, env, tasks, frames)
    report.add("least time: roofline", least, "ms", note=note)


def main(_: list[str]) -> None:
    """Measures and writes the JSON files."""
    milx.configure()
    for name in _DOMAINS.value or (("reach", "push") if common.accelerated() else ("reach",)):
        measure_domain(name)


if __name__ == "__main__":
    app.run(main)
