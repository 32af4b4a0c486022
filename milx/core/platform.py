"""Setup of the JAX platform, which a launcher or the user does once, before JAX starts its backend."""

import os
import pathlib
import warnings

import jax
import jaxlib

_OLD_JAXLIB = tuple(int(part) for part in jaxlib.__version__.split(".")[:2]) < (0, 11)
# CPU flags for jaxlib before 0.11. Unknown flags are fatal, so later versions must not get them.
# - The fusion emitters fuse MJX's kinematic chain by recomputing it, with a cost exponential in the chain's depth.
# - With the concurrent scheduler, two batched LAPACK calls (MJX's Cholesky) can wait for each other forever.
_CPU_FLAGS = {
    "xla_cpu_use_fusion_emitters": "--xla_cpu_use_fusion_emitters=false",
    "xla_cpu_enable_concurrency_optimized_scheduler": "--xla_cpu_enable_concurrency_optimized_scheduler=false",
}


def cache_folder() -> pathlib.Path:
    """Returns the user's cache folder for milx: `$XDG_CACHE_HOME/milx`, or `~/.cache/milx`."""
    home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
    return pathlib.Path(home) / "milx"


def pixel_options() -> dict[str, str | bool]:
    """Returns compiler options for a program that mainly computes pixels, not physics.

    With an old CPU compiler, rendering is up to five times as fast with the fusion emitters, which `configure` turns
    off. The program must not contain `mjx.kinematics` of a chain of more than three joints, which takes four thousand
    times as long with them for seven; `milx.envs.kinematics` does not.
    """
    fuse = _OLD_JAXLIB and jax.default_backend() == "cpu"
    return {"xla_cpu_use_fusion_emitters": True} if fuse else {}


def configure() -> None:
    """Turns on the persistent compilation cache, and sets XLA flags without which old CPU compilers are slow on MJX.

    It must be called before JAX is first used; JAX may be imported before. The cache is in `cache_folder() / "jax"`,
    unless the environment variable `JAX_COMPILATION_CACHE_DIR` names another folder.

    Warns:
        RuntimeWarning: if JAX has already started without flags that MJX needs.
    """
    if missing := _missing_flags():
        from jax._src import xla_bridge  # JAX before 0.11 has no public way to ask

        os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *missing]).strip()
        if xla_bridge.backends_are_initialized():
            late = "milx.configure came after JAX was first used: its XLA flags are ignored"
            warnings.warn(late, RuntimeWarning, stacklevel=2)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder() / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def require_device() -> None:
    """Starts JAX's backend.

    Raises:
        ValueError: if it finds no device, for example because JAX_PLATFORMS names one that is not there.
    """
    try:
        jax.devices()
    except Exception as error:  # a platform may raise any type
        asked = os.environ.get("JAX_PLATFORMS", "")
        raise ValueError(f"JAX_PLATFORMS: got {asked!r}, expected a platform with a device: {error!r:.300}") from error


def warn_if_not_configured() -> None:
    """Warns if XLA flags are missing without which an MJX program may compile for hours, or wait forever.

    Warns:
        RuntimeWarning: on the CPU with jaxlib before 0.11, if `configure` has not been called.
    """
    if jax.default_backend() == "cpu" and (missing := _missing_flags()):
        need = f"JAX started without {' '.join(missing)}: call milx.configure() before it is first used"
        warnings.warn(need, RuntimeWarning, stacklevel=3)


def _missing_flags() -> list[str]:
    given = os.environ.get("XLA_FLAGS", "")
    return [flag for name, flag in _CPU_FLAGS.items() if _OLD_JAXLIB and name not in given]
