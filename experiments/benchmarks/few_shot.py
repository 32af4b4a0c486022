"""Times a meta-gradient of few-shot classification in `milx.meta` and in the libraries that people use for it.

    python experiments/benchmarks/few_shot.py      # networks of Omniglot's and miniImageNet's size
    python experiments/benchmarks/few_shot.py --tasks=4 --steps=1 --networks=omniglot

All compute the meta-gradient of MAML (Finn et al. 2017) with one or five inner steps, of the same random images: five
classes, one image of each to adapt to and 15 to be judged by. The network is MAML's, with max-pooling for both sizes:
four blocks of a convolution, batch normalization, ReLU and max-pooling, and a linear layer. On a CPU milx works on one
task at a time. Its steps are unrolled, as JAX's and torch.func's are. In float32, in which GPUs may multiply in TF32,
and on GPUs in bfloat16, too: then all convolve so, and normalize in float32. A row's note says by how much its gradient
differs from milx's, relative to its norm; torch.func's differs in double precision, too. The peers are installed by
`pip install jaxopt higher torchopt graphviz`; learn2learn, which loops over tasks, does not install on Python 3.12.
"""

import os

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # PyTorch needs memory in the same process

import functools
import itertools
import pathlib
import statistics
import time
from collections.abc import Callable
from typing import Any

import common
import jax
import jax.numpy as jnp
import numpy as np
from absl import app, flags

import milx
from milx import meta

WAYS, SHOTS, QUERIES, RATE = 5, 1, 15, 0.01
NETWORKS = {"omniglot": (28, 1, 64), "miniimagenet": (84, 3, 32)}
"""Height and width, channels, and filters."""
BLOCKS = 4
Params = dict[str, jax.Array]
Convolution = Callable[[jax.Array, jax.Array, int], jax.Array]


def make_params(network: str) -> dict[str, np.ndarray]:
    """Draws parameters, with kernels [3, 3, C, F]."""
    size, channels, filters = NETWORKS[network]
    draw, params = np.random.default_rng(0), {}
    for i in range(BLOCKS):
        params[f"kernel{i}"] = draw.normal(size=(3, 3, channels, filters)) / np.sqrt(9 * channels)
        for name, value in (("bias", 0.0), ("scale", 1.0), ("shift", 0.0)):
            params[f"{name}{i}"] = np.full(filters, value)
        channels, size = filters, size // 2
    params["last"] = draw.normal(size=(size * size * channels, WAYS)) / np.sqrt(size * size * channels)
    params["last_bias"] = np.zeros(WAYS)
    return {name: value.astype(np.float32) for name, value in params.items()}


def make_tasks(network: str, count: int) -> tuple[np.ndarray, ...]:
    """Draws images and labels to adapt to, then images and labels to be judged by, of `count` tasks."""
    size, channels, _ = NETWORKS[network]
    draw, tasks = np.random.default_rng(1), []
    for shots in (SHOTS, QUERIES):
        tasks.append(draw.random((count, WAYS * shots, size, size, channels), np.float32))
        tasks.append(np.tile(np.repeat(np.arange(WAYS, dtype=np.int32), shots), (count, 1)))
    return tuple(tasks)


def loss(convolve: Convolution, dtype: str, params: Params, x: jax.Array, y: jax.Array) -> jax.Array:
    """Computes the mean cross-entropy of images [B, H, W, C] and labels [B]; convolves in a type."""
    for i in range(BLOCKS):
        x = convolve(x.astype(dtype), params[f"kernel{i}"].astype(dtype), 1) + params[f"bias{i}"]
        mean = x.mean((0, 1, 2))
        variance = jnp.square(x - mean).mean((0, 1, 2))
        x = (x - mean) * (jax.lax.rsqrt(variance + 1e-5) * params[f"scale{i}"]) + params[f"shift{i}"]
        height, width = x.shape[1] // 2, x.shape[2] // 2
        x = jax.nn.relu(x)[:, : 2 * height, : 2 * width]
        x = jnp.maximum(x[:, ::2], x[:, 1::2])  # a maximum over axes is differentiated by comparing rounded numbers
        x = jnp.maximum(x[:, :, ::2], x[:, :, 1::2])
    logits = x.reshape(len(x), -1) @ params["last"] + params["last_bias"]
    return -jnp.take_along_axis(jax.nn.log_softmax(logits), y[:, None], 1).mean()


def by_milx(params: Params, tasks: tuple[jax.Array, ...], steps: int, dtype: str) -> Params:
    """Computes the meta-gradient with milx."""
    inner = functools.partial(loss, meta.conv2d, dtype)

    def task_loss(params: Params, task: tuple[jax.Array, ...]) -> jax.Array:
        adapted = meta.adapt(inner, params, *task[:2], steps=steps, rate=RATE, unroll=max(steps, 1))
        return inner(adapted, *task[2:])

    return meta.meta_gradient(task_loss, params, tasks, at_once=None if common.accelerated() else 1)[0]


def by_jax(params: Params, tasks: tuple[jax.Array, ...], steps: int, dtype: str) -> Params:
    """Computes the meta-gradient as one would write it first."""
    inner = functools.partial(loss, common.lax_convolution, dtype)

    def task_loss(params: Params, x: jax.Array, y: jax.Array, query: jax.Array, wanted: jax.Array) -> jax.Array:
        for _ in range(steps):
            params = jax.tree.map(lambda p, g: p - RATE * g, params, jax.grad(inner)(params, x, y))
        return inner(params, query, wanted)

    of_tasks = jax.vmap(task_loss, in_axes=(None, 0, 0, 0, 0))
    return jax.grad(lambda params: of_tasks(params, *tasks).mean())(params)


def by_jaxopt(params: Params, tasks: tuple[jax.Array, ...], steps: int, dtype: str) -> Params:
    """Computes the meta-gradient with jaxopt (Blondel et al. 2022), whose gradient descent scans all but one step."""
    import jaxopt

    inner = functools.partial(loss, common.lax_convolution, dtype)
    options = {"maxiter": steps, "tol": 0.0, "acceleration": False, "implicit_diff": False, "unroll": True}
    solver = jaxopt.GradientDescent(inner, stepsize=RATE, **options)

    def task_loss(params: Params, x: jax.Array, y: jax.Array, query: jax.Array, wanted: jax.Array) -> jax.Array:
        return inner(solver.run(params, x, y).params, query, wanted)

    of_tasks = jax.vmap(task_loss, in_axes=(None, 0, 0, 0, 0))
    return jax.grad(lambda params: of_tasks(params, *tasks).mean())(params)


def measure_jax(
    by: Callable[..., Params], network: str, count: int, steps: int, dtype: str
) -> tuple[float, float, Params]:
    """Measures the median ms and GiB of a meta-gradient in JAX, and returns it."""
    params, tasks = jax.tree.map(jnp.asarray, (make_params(network), make_tasks(network, count)))
    compiled = jax.jit(by, static_argnums=(2, 3)).lower(params, tasks, steps, dtype).compile()
    return (
        median_ms(lambda: jax.block_until_ready(compiled(params, tasks))),
        common.gib(compiled),
        compiled(params, tasks),
    )


def measure_torch(name: str, network: str, count: int, steps: int, dtype: str) -> tuple[float, float | None, Params]:
    """Measures the median ms and, on a GPU, the peak GiB of a meta-gradient in PyTorch, and returns it."""
    import few_shot_torch
    import torch

    gpu = torch.cuda.is_available() and common.accelerated()
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = True
    torch.backends.cudnn.benchmark = True

    def tensor(x: np.ndarray) -> Any:
        made = torch.from_numpy(x).to("cuda" if gpu else "cpu")
        if x.ndim == 5:  # images
            return made.movedim(-1, -3).contiguous().to(getattr(torch, dtype))
        if x.ndim == 4:  # kernels
            return made.permute(3, 2, 0, 1).contiguous()
        return made if made.is_floating_point() else made.long()

    side = NETWORKS[network][0] >> BLOCKS
    params, tasks = jax.tree.map(tensor, (make_params(network), make_tasks(network, count)))
    last = make_params(network)["last"].reshape(side, side, -1, WAYS)
    params["last"] = tensor(last.transpose(2, 0, 1, 3).reshape(-1, WAYS))  # channels come first here
    by = few_shot_torch.PEERS[name]

    def call() -> Any:
        found = by(params, tasks, steps, RATE)
        if gpu:
            torch.cuda.synchronize()
        return found

    call()
    if gpu:
        torch.cuda.reset_peak_memory_stats()
    milliseconds = median_ms(call)
    memory = torch.cuda.max_memory_allocated() / 2**30 if gpu else None
    found = {key: value.cpu().numpy() for key, value in call().items()}
    kernels = {f"kernel{i}": found[f"kernel{i}"].transpose(2, 3, 1, 0) for i in range(BLOCKS)}
    last = found["last"].reshape(-1, side, side, WAYS).transpose(1, 2, 0, 3).reshape(-1, WAYS)
    torch.cuda.empty_cache()
    return milliseconds, memory, {**found, **kernels, "last": last}


def median_ms(call: Callable[[], Any]) -> float:
    """Measures the median time of a call in ms, after one to warm up: of 20, or of at least 3 that take a second."""
    call()
    times: list[float] = []
    while len(times) < 3 or (len(times) < 20 and sum(times) < 1.0):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return 1e3 * statistics.median(times)


def difference(found: Params, reference: Params) -> float:
    """Computes the norm of the difference of two gradients, relative to the second."""
    squares = [
        (np.square(np.asarray(found[k]) - np.asarray(v)).sum(), np.square(v).sum()) for k, v in reference.items()
    ]
    return float(np.sqrt(sum(d for d, _ in squares) / sum(n for _, n in squares)))


def measure(report: common.Report, network: str, steps: int, count: int, dtype: str, peers: list[str]) -> None:
    """Adds the rows of a network, a number of inner steps and a number of tasks, in a type."""
    reference: dict[str, Any] = {}
    case = f"{steps} step{'s' * (steps > 1)}, {count} tasks"
    jaxes = {"milx": by_milx, "JAX, vmap over lax.conv": by_jax, "jaxopt": by_jaxopt}
    for name in peers:
        began, row = time.perf_counter(), len(report.rows)

        def run(name: str = name) -> tuple[float, float | None]:
            found = (
                measure_jax(jaxes[name], network, count, steps, dtype)
                if name in jaxes
                else measure_torch(name, network, count, steps, dtype)
            )
            if name == "milx":
                reference["gradient"] = found[2]
            elif reference:
                reference["apart"] = f"{difference(found[2], reference['gradient']):.1e} from milx's; "
            return found[0], found[1]

        report.attempt(f"{case}: {name}", "ms", run)
        if report.rows[row]["median"] is not None:
            report.rows[row]["note"] = f"{reference.pop('apart', '')}{time.perf_counter() - began:.0f} s in all"
            report.write()
            print(" " * 11, report.rows[row]["note"], flush=True)


def main(_: list[str]) -> None:
    """Measures and writes the JSON files."""
    milx.configure()
    accelerated = common.accelerated()
    networks = _NETWORKS.value or (list(NETWORKS) if accelerated else ["omniglot"])
    types = _TYPES.value or (["float32", "bfloat16"] if accelerated else ["float32"])
    for network, dtype in itertools.product(networks, types):
        name = f"few_shot-{network}" if dtype == "float32" else f"few_shot-{network}-{dtype}"
        report = common.Report(name, pathlib.Path(_OUT.value))
        for steps in map(int, _STEPS.value):
            for count in map(int, _TASKS.value or (("4", "64") if accelerated else ("4",))):
                measure(report, network, steps, count, dtype, _PEERS.value)


if __name__ == "__main__":
    names = [
        "milx",
        "JAX, vmap over lax.conv",
        "jaxopt",
        "PyTorch, loop",
        "PyTorch, torch.func",
        "PyTorch, torch.func, compiled",
        "higher",
        "TorchOpt",
    ]
    _OUT = flags.DEFINE_string("out", str(common.RESULTS), "Folder of the JSON files.")
    _NETWORKS = flags.DEFINE_multi_enum(
        "networks", None, list(NETWORKS), "Which; all, or Omniglot's on a CPU, by default (repeat the flag)."
    )
    _TYPES = flags.DEFINE_multi_enum(
        "types",
        None,
        ["float32", "bfloat16"],
        "In which types; both, or float32 on a CPU, by default (repeat the flag).",
    )
    _TASKS = flags.DEFINE_list("tasks", None, "Numbers of tasks; 4 and 64, or 4 on a CPU, by default.")
    _STEPS = flags.DEFINE_list("steps", ["1", "5"], "Numbers of inner steps.")
    _PEERS = flags.DEFINE_multi_enum("peers", names, names, "Who; milx comes first (repeat the flag).")
    app.run(main)
