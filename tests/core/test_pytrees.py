"""Pytrees in files: damaged and missing ones are made again, and a full disk costs the file, not the pytree."""

import os
import pathlib
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

from milx.core import files, pytrees
from milx.core.files import FileError

TREE = {"a": jnp.arange(6.0).reshape(2, 3), "b": (jnp.zeros(0), jnp.ones((), jnp.int32))}


def test_what_is_written_is_read(tmp_path):
    pytrees.write(tmp_path / "tree.npz", TREE)
    read = pytrees.read(tmp_path / "tree.npz", TREE)
    assert pytrees.fingerprint(read) == pytrees.fingerprint(TREE)
    other = TREE | {"a": jnp.zeros((3, 2))}
    with pytest.raises(FileError, match=r"tree\.npz: a: got float32 \(2, 3\), expected float32 \(3, 2\)"):
        pytrees.read(tmp_path / "tree.npz", other)
    with pytest.raises(FileError, match=r"tree\.npz: c: missing, expected float32 \(1,\)"):
        pytrees.read(tmp_path / "tree.npz", TREE | {"c": jnp.zeros(1)})


def test_a_pytree_that_cannot_be_kept_is_returned_and_reported(tmp_path, monkeypatch, capsys):
    def full(*_, **__):
        raise FileError("tree.npz: cannot be written: No space left on device")

    monkeypatch.setattr(files, "write_arrays", full)
    made = pytrees.kept(tmp_path / "tree.npz", lambda: TREE, lambda: TREE)
    assert pytrees.fingerprint(made) == pytrees.fingerprint(TREE)
    expected = "milx: tree.npz: cannot be written: No space left on device; its contents are used, but not kept\n"
    assert capsys.readouterr().err == expected


KEEP = """
import pathlib, sys, os
os.getpid = lambda: 7  # as in containers, where every first process has the same number
import numpy as np
from milx.core import pytrees
value = int(sys.argv[2])
for _ in range(40):
    pytrees.write(pathlib.Path(sys.argv[1]), {"a": np.full(20_000, value)})
"""


def test_processes_of_the_same_number_do_not_disturb_each_other(tmp_path):
    """Writes one file from three processes at once: all of them end well, and what is left is whole."""
    path = tmp_path / "tree.npz"
    writers = [subprocess.Popen([sys.executable, "-c", KEEP, path, str(i)], env=os.environ) for i in range(3)]
    assert [writer.wait() for writer in writers] == [0, 0, 0]
    found = pytrees.read(path, {"a": np.zeros(20_000, int)})["a"]
    assert len(set(np.asarray(found).tolist())) == 1
    assert [entry.name for entry in pathlib.Path(tmp_path).iterdir()] == ["tree.npz"]
