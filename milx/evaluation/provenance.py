"""Where a result comes from: commit, hardware and versions."""

import importlib.metadata
import os
import pathlib
import platform
import subprocess
from collections.abc import Iterable
from typing import Any

import jax

_PACKAGES = ("milx", "jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "optax", "orbax-checkpoint", "numpy", "warp-lang")


def origin() -> dict[str, Any]:
    """Collects commit, hardware and versions."""
    return {"commit": commit(), "hardware": _hardware(), "versions": versions(_PACKAGES)}


def commit() -> str | None:
    """Returns the commit, "-dirty" if the tree has changed; None outside a checkout. MILX_COMMIT overrides it."""
    if "MILX_COMMIT" in os.environ:
        return os.environ["MILX_COMMIT"]
    folder = pathlib.Path(__file__).parent
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def _hardware() -> str:
    devices = jax.devices()
    kind = devices[0].device_kind if devices[0].platform != "cpu" else platform.processor() or platform.machine()
    return f"{len(devices)} x {kind}, {os.cpu_count()} CPU cores"


def versions(packages: Iterable[str]) -> dict[str, str]:
    """Looks up Python's version and those of packages, "not installed" for those that lack."""
    found = {"python": platform.python_version()}
    for package in packages:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found
