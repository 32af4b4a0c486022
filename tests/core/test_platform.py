"""Importing milx leaves the process as it was; what JAX needs is set by a call, and its lack is said."""

import os
import subprocess
import sys

import jaxlib
import pytest

OLD = tuple(int(part) for part in jaxlib.__version__.split(".")[:2]) < (0, 11)
STATE = """
import os, sys, warnings
import jax
warnings.simplefilter("error")
def state():
    return dict(os.environ), jax.config.jax_compilation_cache_dir, sys.stdout, sys.stderr
before = state()
import milx
assert state() == before
from jax._src import xla_bridge
assert not xla_bridge.backends_are_initialized()
"""


def run(program, **environment):
    """Returns what a fresh process prints, with XLA's flags as they are for users."""
    clean = {
        name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR")
    }
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=clean | environment)
    return done.returncode, done.stdout, done.stderr


def test_an_import_changes_nothing_and_says_nothing():
    assert run(STATE) == (0, "", "")


def test_configured_in_time_an_environment_is_content(tmp_path):
    program = (
        STATE
        + "milx.configure()\nenv = milx.gym.GymEnv('reach_state').env\nprint(jax.config.jax_compilation_cache_dir)"
    )
    code, said, error = run(program, XDG_CACHE_HOME=str(tmp_path))
    assert (code, said.strip()) == (0, str(tmp_path / "milx" / "jax")), error
    assert "warp" not in error, "MJX misses a package that nobody needs here, and says so when it is imported"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("calls", "message"),
    [
        ("milx.make('reach_state')", "JAX started without --xla_cpu_use_fusion_emitters=false"),
        ("jax.devices(); milx.configure()", "milx.configure came after JAX was first used"),
    ],
)
def test_what_came_too_late_is_said(calls, message):
    """Warns for compilers that need flags; later ones need none."""
    code, _, error = run(f"{STATE}{calls}")
    assert (code == 1) == (f"RuntimeWarning: {message}" in error) == OLD
