"""What all benchmarks share: timing, and one JSON file of rows in experiments/results/benchmarks/."""

import dataclasses
import datetime
import json
import pathlib
import statistics
import time
from collections.abc import Callable
from typing import Any

import jax

from milx.evaluation import provenance

RESULTS = pathlib.Path(__file__).parents[1] / "results" / "benchmarks"


def accelerated() -> bool:
    """Tells whether JAX has an accelerator. It starts JAX, so `milx.configure` comes before."""
    return jax.default_backend() != "cpu"


def median_ms(
    function: Callable[..., Any], *args: Any, repeats: int = 20, wait: Callable = jax.block_until_ready
) -> float:
    """Measures the median time of a call in ms, after one call to warm up; `wait` blocks until a result is there."""
    wait(function(*args))
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        wait(function(*args))
        times.append(time.perf_counter() - began)
    return 1e3 * statistics.median(times)


def lax_convolution(x: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    """Convolves [B, H, W, C] with [k, k, C, F] and SAME padding, as one would write it first."""
    numbers = ("NHWC", "HWIO", "NHWC")
    return jax.lax.conv_general_dilated(x, kernel, (stride, stride), "SAME", dimension_numbers=numbers)


def gib(compiled: jax.stages.Compiled) -> float:
    """Returns the memory a compiled program needs beside arguments and results; PyTorch's numbers include those."""
    memory = compiled.memory_analysis()
    assert memory is not None, "CPUs and GPUs tell"
    return memory.temp_size_in_bytes / 2**30


@dataclasses.dataclass
class Report:
    """Rows of one benchmark, printed as they come and written as JSON after each, so that a crash loses none.

    Attributes:
        benchmark: the file's name, but for "-cpu" where there is no accelerator.
        folder: where it goes.
    """

    benchmark: str
    folder: pathlib.Path
    rows: list[dict[str, Any]] = dataclasses.field(default_factory=list)

    def add(self, name: str, median: float | None, unit: str, memory: float | None = None, note: str = "") -> None:
        """Adds a row, named "question: who" (`summary.py`); a median of None says that it was not run, the note why."""
        row = {"name": name, "median": median, "unit": unit, "peak_memory_gib": memory, "note": note}
        self.rows.append(row)
        value = "not run" if median is None else f"{median:,.4g} {unit}"
        print(f"{self.benchmark:10s} {name:60s} {value:>20s} {note}", flush=True)
        self.write()

    def write(self) -> None:
        """Writes what there is."""
        self.folder.mkdir(parents=True, exist_ok=True)
        today = datetime.datetime.now(datetime.UTC).date().isoformat()
        content = {"benchmark": self.benchmark, "date": today, **provenance.origin(), "rows": self.rows}
        content["versions"] |= provenance.versions(("torch", "hydrax", "jaxopt", "higher", "torchopt"))
        file = self.benchmark if accelerated() else f"{self.benchmark}-cpu"
        (self.folder / f"{file}.json").write_text(json.dumps(content, indent=1) + "\n")

    def measure(self, name: str, unit: str, function: Callable[[], tuple[float, float | None]], note: str = "") -> None:
        """Adds what `function` returns: (median, memory)."""
        median, memory = function()
        self.add(name, median, unit, memory, note)

    def attempt(self, name: str, unit: str, function: Callable[[], tuple[float, float | None]], note: str = "") -> None:
        """Measures a peer in the same way; if it cannot run here, says so instead."""
        try:
            self.measure(name, unit, function, note)
        except Exception as error:  # whatever keeps a peer from running is the finding
            text = str(error).strip().splitlines()
            self.add(name, None, unit, note=f"{type(error).__name__}: {text[0][:150] if text else ''}")
