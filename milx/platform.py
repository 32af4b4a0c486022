"""Set-up of the JAX platform: done once, when milx is imported and before JAX starts its backend."""

import contextlib
import io
import os
import pathlib

import jax
import jaxlib

_OLD_JAXLIB = tuple(int(part) for part in jaxlib.__version__.split(".")[:2]) < (0, 11)
# CPU flags for jaxlib before 0.11; unknown flags are fatal, so later versions must not see them.
# - Fusion emitters fuse MJX's kinematic chain by recomputing it, exponentially in the depth of the chain.
# - The concurrent scheduler lets two batched LAPACK calls (MJX's Cholesky) wait for each other for ever.
_CPU_FLAGS = {
    "xla_cpu_use_fusion_emitters": "--xla_cpu_use_fusion_emitters=false",
    "xla_cpu_enable_concurrency_optimized_scheduler": "--xla_cpu_enable_concurrency_optimized_scheduler=false",
}

_SHORT_CHAIN = 3
"""Joints in a chain whose recomputation costs nothing: a chain of seven takes four thousand times as long."""


def cache_folder() -> pathlib.Path:
    """The user's cache folder for milx: `$XDG_CACHE_HOME/milx`, or `~/.cache/milx`."""
    home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(home) / "milx"


def pixel_options(chain: int = 0) -> dict[str, str | bool]:
    """Compiler options for a program of pixels rather than physics.

    On an old CPU compiler the fusion emitters that `configure` turns off render five times as fast.

    Args:
        chain: joints in the longest kinematic chain that the program computes poses of.
    """
    fuse = _OLD_JAXLIB and jax.default_backend() == "cpu" and chain <= _SHORT_CHAIN
    return {"xla_cpu_use_fusion_emitters": True} if fuse else {}


def import_mjx() -> None:
    """Imports MJX, which else prints a line for each optional package of its that is not installed."""
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        import mujoco.mjx  # noqa: F401


def configure() -> None:
    """Turns the persistent compilation cache on and works around slow MJX code of old CPU compilers.

    The cache lives in `cache_folder() / "jax"`; `JAX_COMPILATION_CACHE_DIR` moves it.
    """
    if _OLD_JAXLIB:
        given = os.environ.get("XLA_FLAGS", "")
        added = [flag for name, flag in _CPU_FLAGS.items() if name not in given]
        os.environ["XLA_FLAGS"] = " ".join([given, *added]).strip()
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder() / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
