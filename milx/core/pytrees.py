"""Pytrees of arrays: the arrays' names, a hash of their contents, and files that store them."""

import hashlib
import pathlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from milx.core import files, parallel
from milx.core.files import FileError
from milx.core.messages import warn


def leaves(tree: Any) -> dict[str, Any]:
    """Returns all arrays by name, such as "states.qpos", in a fixed order."""
    pairs, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in pairs}


def overlaid(tree: Any, other: Any) -> tuple[Any, list[str]]:
    """Replaces the arrays of a tree by those of another one that have the same names and shapes, in the tree's types.

    Returns:
        The new tree, and the names of what is replaced.
    """
    theirs, replaced = leaves(other), []

    def replace(path: tuple, leaf: Any) -> Any:
        name = jax.tree_util.keystr(path, simple=True, separator=".")
        if name not in theirs or theirs[name].shape != leaf.shape:
            return leaf
        replaced.append(name)
        return jax.numpy.asarray(theirs[name], leaf.dtype)

    return jax.tree_util.tree_map_with_path(replace, tree), replaced


def read_tensors(path: pathlib.Path) -> dict[str, np.ndarray]:
    """Reads arrays by name from a .npz or a .safetensors file, which another program may have written.

    Raises:
        FileError: if it cannot be read, or is a .safetensors file and the package safetensors is missing.
    """
    try:
        if path.suffix == ".npz":
            return files.read_arrays(path.resolve())
        from safetensors.numpy import load

        return load(files.read_bytes(path.resolve()))
    except ImportError as error:
        raise FileError(f"{path} needs the package safetensors; pip install it") from error
    except Exception as error:  # safetensors and zipfile raise many types
        raise FileError(f"{path} cannot be read: {error}") from error


def fingerprint(tree: Any) -> str:
    """Computes the SHA-256 hash of the names, types, shapes and contents of all arrays."""
    digest = hashlib.sha256()
    for name, leaf in leaves(tree).items():
        array = np.ascontiguousarray(leaf)
        digest.update(f"{name} {array.dtype} {array.shape} ".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def write(path: pathlib.Path, tree: Any) -> None:
    """Writes a pytree as one .npz file; an existing file is replaced only when the new one is complete.

    Raises:
        FileError: if it cannot be written.
    """
    files.write_arrays(path, {name: np.asarray(leaf) for name, leaf in leaves(tree).items()})


def read(path: pathlib.Path, like: Any) -> Any:
    """Reads a pytree written by `write`.

    Args:
        path: the .npz file.
        like: a pytree (of arrays or shapes) with the expected names, types and shapes, e.g. from `jax.eval_shape`.

    Raises:
        FileError: if the file cannot be read, or an array is missing or has another type or shape; the message names
            the array.
    """
    loaded, arrays = [], files.read_arrays(path)
    for name, expected in leaves(like).items():
        if name not in arrays:
            raise FileError(f"{path}: {name}: missing, expected {expected.dtype} {expected.shape}")
        array = arrays[name]
        if array.shape != expected.shape or array.dtype != expected.dtype:
            raise FileError(
                f"{path}: {name}: got {array.dtype} {array.shape}, expected {expected.dtype} {expected.shape}"
            )
        loaded.append(jnp.asarray(array))
    return jax.tree.unflatten(jax.tree.structure(like), loaded)


def kept(path: pathlib.Path, make: Callable[[], Any], like: Callable[[], Any]) -> Any:
    """Loads the pytree at `path`, or makes it and writes it there.

    A damaged file is reported and written again. One that cannot be written, for example on a full disk, is reported,
    too, and the pytree that was made is returned all the same.

    Args:
        path: the .npz file.
        make: returns the pytree.
        like: returns a pytree of shapes with the same structure, as `read` needs it.

    Returns:
        The pytree.
    """
    if parallel.on_all_hosts(path.is_file()):
        try:
            return read(path, like())
        except FileError as error:
            warn(f"{error}; its contents are made again")
    tree = make()
    try:
        write(path, tree)
    except FileError as error:
        warn(f"{error}; its contents are used, but not kept")
    return tree
