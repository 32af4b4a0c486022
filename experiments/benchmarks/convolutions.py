"""Times convolutions of tasks that have kernels of their own, and both transposes, at the sizes of policies' layers.

    python experiments/benchmarks/convolutions.py    # on a GPU

milx convolves by kernels of a GPU (`milx.meta.task_convolution`), as policies do in bfloat16, or by blocks, and the
peer is vmap over `lax.conv`. All numbers are random, and in bfloat16. A note says by how much the kernels' result
differs from that of blocks, relative to its norm.
"""

import functools
import pathlib
from collections.abc import Callable
from typing import Any

import common
import jax
import jax.numpy as jnp
from absl import app, flags

import milx
from milx.meta.convolution import convolve_blocks
from milx.meta.task_convolution import convolve_directly

LAYERS = {
    "push 1": (15, 100, 125, 125, 3, 16, 5),
    "push 2": (15, 100, 63, 63, 16, 16, 5),
    "push 3": (15, 100, 32, 32, 16, 16, 5),
    "reach 1": (5, 50, 64, 80, 3, 40, 3),
    "reach 2": (5, 50, 32, 40, 40, 40, 3),
    "reach fast 2": (64, 3, 32, 40, 40, 40, 3),
}
"""Tasks, images of each, height, width, channels, filters, and side of the kernel, for a stride of 2."""
STRIDE = 2
WAYS = {
    "milx, kernels": convolve_directly,
    "milx, blocks": convolve_blocks,
    "vmap over lax.conv": common.lax_convolution,
}
LOOPS = 20
Operation = Callable[[jax.Array, jax.Array], jax.Array]
_OUT = flags.DEFINE_string("out", str(common.RESULTS), "Folder of the JSON file.")


def operations(layer: str, convolve: Any) -> dict[str, tuple[Operation, jax.Array, jax.Array]]:
    """Returns the value and its transposes, each with its arguments."""
    tasks, images, height, width, channels, filters, taps = LAYERS[layer]
    mapped = jax.vmap(lambda x, kernel: convolve(x, kernel, STRIDE))
    keys = jax.random.split(jax.random.key(0), 3)
    x = jax.random.normal(keys[0], (tasks, images, height, width, channels), jnp.bfloat16)
    kernel = jax.random.normal(keys[1], (tasks, taps, taps, channels, filters), jnp.bfloat16)
    shape = (tasks, images, -(-height // STRIDE), -(-width // STRIDE), filters)
    dy = jax.random.normal(keys[2], shape, jnp.bfloat16)
    to_input = lambda dy, kernel: jax.vjp(lambda x: mapped(x, kernel), x)[1](dy)[0]  # noqa: E731
    to_kernel = lambda x, dy: jax.vjp(lambda kernel: mapped(x, kernel), kernel)[1](dy)[0]  # noqa: E731
    found: dict[str, tuple[Operation, jax.Array, jax.Array]] = {"value": (mapped, x, kernel)}
    if channels > 3:  # images need no gradient
        found["gradient of images"] = (to_input, dy, kernel)
    return found | {"gradient of kernels": (to_kernel, x, dy)}


def measure(operation: Operation, a: jax.Array, b: jax.Array) -> tuple[float, float]:
    """Measures the ms of an operation, the mean of those in a loop on the device, and its GiB."""

    def step(_: int, carried: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        a, b, before = jax.lax.optimization_barrier(carried)  # the next result depends on the last one
        result = jax.lax.optimization_barrier(operation(a, b))  # all of it, although one number is used
        return a, b, before + result.ravel()[0]

    run = jax.jit(lambda a, b: jax.lax.fori_loop(0, LOOPS, step, (a, b, jnp.zeros((), a.dtype)))[2])
    compiled = run.lower(a, b).compile()
    return common.median_ms(compiled, a, b) / LOOPS, common.gib(compiled)


def difference(layer: str, what: str) -> float:
    """Computes by how much the result of the kernels differs from that of blocks, relative to its norm."""
    found, expected = (
        jax.jit(operation)(*args).astype(jnp.float32)
        for operation, *args in (operations(layer, way)[what] for way in (convolve_directly, convolve_blocks))
    )
    return float(jnp.linalg.norm(found - expected) / jnp.linalg.norm(expected))


def main(_: list[str]) -> None:
    """Measures and writes the JSON file."""
    milx.configure()
    report = common.Report("convolutions", pathlib.Path(_OUT.value))
    for layer in LAYERS:
        for way, convolve in WAYS.items():
            for what, (operation, *args) in operations(layer, convolve).items():
                measured = functools.partial(measure, operation, *args)
                report.attempt(f"{layer}, {what}: {way}", "ms", measured)
                if convolve is convolve_directly and report.rows[-1]["median"] is not None:
                    report.rows[-1]["note"] = f"differs from blocks by {difference(layer, what):.1e}"


if __name__ == "__main__":
    app.run(main)
