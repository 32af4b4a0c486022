"""Set-up of the JAX platform: done once, when milx is imported and before JAX starts its backend."""

import os
import pathlib

import jax
import jaxlib

# jaxlib before 0.11 fuses MJX's kinematic chain on the CPU by recomputing it, exponentially in the depth of the
# chain. Turning the fusion emitters off cures it. From 0.11 on the flag is unknown, and unknown flags are fatal.
_FUSION_FLAG = "--xla_cpu_use_fusion_emitters=false"


def configure() -> None:
    """Turns the persistent compilation cache on and works around slow MJX code of old CPU compilers.

    The cache lives in the user's cache folder (`$XDG_CACHE_HOME/milx/jax`); `JAX_COMPILATION_CACHE_DIR` moves it.
    """
    version = tuple(int(part) for part in jaxlib.__version__.split(".")[:2])
    flags = os.environ.get("XLA_FLAGS", "")
    if version < (0, 11) and "xla_cpu_use_fusion_emitters" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_FUSION_FLAG}".strip()
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(pathlib.Path(home) / "milx" / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
