"""Damaged bytes of every format that milx reads: an error of ours or the value, never a crash, a hang or much memory.

Each format is read in a process of its own, with seeds that are the same every time.
"""

import faulthandler
import io
import json
import multiprocessing
import pathlib
import resource
import shutil
import traceback

import numpy as np
import pytest
from absl import logging
from PIL import Image

from milx.config import assemble
from milx.config.assemble import make_config
from milx.core import files
from milx.core.checkpoint import Checkpoints
from milx.data import lerobot
from milx.data.dataset import DataSet, Writer
from milx.data.lerobot import LeRobot
from milx.data.robomimic import Robomimic
from milx.deploy import policy, standalone
from milx.training.state import parse_extra
from milx.types import Demo, Spec

FIXTURES = pathlib.Path(__file__).parent / "fixtures"
GIB = 1.0
"""The most memory that reading damaged files may take beyond that of the imports."""


def damaged(content, rng):
    """Changes bytes, bits or a run of a file, or cuts it off."""
    changed = bytearray(content)
    for _ in range(rng.integers(1, 9)):
        at = rng.integers(len(changed)) if rng.random() < 0.7 else rng.integers(min(len(changed), 200))
        kind = rng.integers(4)
        if kind == 0:
            changed[at] ^= 1 << rng.integers(8)
        elif kind == 1:
            changed[at] = rng.integers(256)
        elif kind == 2:
            changed[at : at + 8] = bytes([rng.choice([0, 255])]) * min(8, len(changed) - at)
        elif rng.random() < 0.2:
            del changed[max(at, 1) :]
    return bytes(changed)


def read_robomimic(folder):
    for episode in Robomimic(folder / "stack.hdf5", None, "robot0_eef_pos", "actions", 128).episodes("file"):
        episode.read()


def read_lerobot(folder):
    lerobot._read_table.cache_clear()
    for camera in ("observation.images.top", "observation.images.wrist"):
        for episode in LeRobot(folder, camera, "observation.state", "action", 128).episodes("task_index")[:2]:
            episode.read()


def read_data_set(folder):
    data = DataSet(folder)
    for number, task in enumerate(data.header.tasks):
        for demo in range(len(task.lengths)):
            data.read(number, demo)


def write_data_set(folder):
    demo = Demo(np.zeros((6, 4, 5, 3), np.uint8), np.zeros((6, 3)), np.ones((6, 2)))
    shutil.rmtree(folder)
    with Writer(folder, (4, 5), 3, 2, "a test") as writer:
        writer.add("one", "train", [6, 6], [demo, demo])


def write_images(folder):
    for name in ("png", "jpeg"):
        content = io.BytesIO()
        Image.fromarray(np.arange(1200, dtype=np.uint8).reshape(20, 20, 3)).save(content, name)
        (folder / name).write_bytes(content.getvalue())


def read_images(folder):
    for path in sorted(folder.iterdir()):
        list(lerobot._images(path, [{"bytes": path.read_bytes()}]))


def write_json(folder):
    files.write_json(folder / "config.json", assemble.to_dict(make_config("push", preset="cpu")))
    files.write_json(folder / "spec.json", Spec((4, 5), 3, 2, ((-1.0, -2.0), (1.0, 2.0)), (0, 1)).to_dict())


def read_json(folder):
    for read, name in ((assemble.read, "config.json"), (policy.read_spec, "spec.json")):
        read(folder / name)


def copied(*parts):
    """Returns a function that copies a folder of the fixtures."""
    return lambda folder: shutil.copytree(FIXTURES.joinpath(*parts), folder, dirs_exist_ok=True)


def write_checkpoint(folder):
    """Copies a checkpoint without its checksums, so that what is damaged reaches the libraries that read it."""
    copied("golden", "0.1.0", "run", "checkpoints")(folder)
    for path in folder.glob("*/checksums.json"):
        path.unlink()


def read_checkpoint(folder):
    checkpoints = Checkpoints(folder, read_only=True, report=lambda _: None)
    _, extra = checkpoints.restore(checkpoints.latest, {})
    parse_extra(checkpoints, checkpoints.latest, extra)
    checkpoints.score(checkpoints.latest)


KINDS = {
    "hdf5": (lambda folder: shutil.copy(FIXTURES / "robomimic" / "stack.hdf5", folder), read_robomimic, "*.hdf5", 600),
    "parquet": (copied("lerobot"), read_lerobot, "**/*.parquet", 150),
    "mp4": (copied("lerobot"), read_lerobot, "**/*.mp4", 150),
    "export": (copied("golden", "0.1.0", "exported"), standalone.Policy, "*", 150),
    "checkpoint": (write_checkpoint, read_checkpoint, "**/*", 150),
    "images": (write_images, read_images, "*", 500),
    "zarr": (write_data_set, read_data_set, "**/*", 300),
    "npz": (
        lambda folder: files.write_arrays(folder / "a.npz", {"a": np.arange(999.0), "b": np.ones((3, 4))}),
        lambda folder: files.read_arrays(folder / "a.npz"),
        "*",
        500,
    ),
    "json": (write_json, read_json, "*", 1000),
}
"""By format: what makes good files, what reads them, which of them are damaged, and how often."""


def fuzz(kind, folder, report):
    """Damages a file and reads, again and again; writes what was wrong to `report`."""
    make, read, pattern, times = KINDS[kind]
    with report.open("w") as log:
        faulthandler.enable(log)
        logging.set_verbosity(logging.ERROR)  # as the launchers do
        make(folder)
        read(folder)  # before it is damaged, all is well
        paths = sorted(path for path in folder.glob(pattern) if path.is_file())
        before, refused = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, 0
        for seed in range(times):
            rng = np.random.default_rng(seed)
            path = paths[seed % len(paths)]
            content = path.read_bytes()
            path.write_bytes(damaged(content, rng))
            try:
                read(folder)
            except ValueError as error:
                refused += 1
                if "expected" not in str(error) and "cannot" not in str(error):
                    log.write(f"seed {seed}, {path.name}: {error}\n")
            except BaseException:
                log.write(f"seed {seed}, {path.name}: {traceback.format_exc()[-1500:]}\n")
            path.write_bytes(content)
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 2**20
        if grown > GIB:
            log.write(f"{grown:.2f} GiB of memory\n")
        if not refused:
            log.write("nothing was refused\n")
        log.write("done")


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_are_refused_or_read(tmp_path, kind):
    folder, report = tmp_path / "files", tmp_path / "report"
    folder.mkdir()
    process = multiprocessing.get_context("forkserver").Process(target=fuzz, args=(kind, folder, report))
    process.start()
    process.join(120)
    hung = process.is_alive()
    process.kill()
    process.join()
    assert not hung
    assert (process.exitcode, report.read_text()[-5000:]) == (0, "done")


def test_the_header_that_is_fuzzed_is_read(tmp_path):
    """Checks that what the fuzzing begins with is what it should be."""
    folder = tmp_path / "set"
    folder.mkdir()
    write_data_set(folder)
    assert json.loads((folder / "zarr.json").read_text())["attributes"]["milx"]["action_size"] == 2
    read_data_set(folder)
