"""Checkpoints, written with Orbax: the latest and the best are kept, each with checksums of its files.

A damaged checkpoint is reported, and the one before it is used. When a run continues, its damaged checkpoints are moved
to `damaged/` beside the folder of checkpoints. Nothing is lost, and checkpoints of the same steps can be written again.
"""

import contextlib
import functools
import pathlib
import shutil
import tempfile
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from absl import logging
from orbax.checkpoint import checkpoint_managers as policies

from milx.core import files, parallel
from milx.core.files import FileError
from milx.core.messages import warn

UNVALIDATED = -1e9
"""The score of a checkpoint that has not been validated: it is the best one only if there is no other."""
FORMAT = 1
"""The number of what `Checkpoints.save` writes."""
_CHECKSUMS = "checksums.json"
_METADATA = "_CHECKPOINT_METADATA"


class Checkpoints:
    """The checkpoints of a run.

    Args:
        folder: the folder of the checkpoints; created if missing, unless `read_only` is set.
        read_only: only read checkpoints, and never write to the folder.
        report: is called with a message about each checkpoint that is damaged or could not be written.

    Raises:
        ValueError: if there are checkpoints and all of them are damaged.
    """

    def __init__(self, folder: pathlib.Path, read_only: bool = False, report: Callable[[str], None] = warn):
        self.folder, self._read_only, self._report = folder.absolute(), read_only, report
        self._view: tempfile.TemporaryDirectory | None = None
        self._manager = self._open(self._without_damaged())

    @property
    def latest(self) -> int | None:
        """Step of the newest checkpoint; None if there is none."""
        return self._manager.latest_step()

    @property
    def best(self) -> int | None:
        """Step of the checkpoint with the highest score; None if there is none."""
        return self._manager.best_step()

    def save(self, step: int, items: dict[str, Any], score: float, extra: dict[str, Any]) -> bool:
        """Writes pytrees of arrays as a checkpoint.

        If it cannot be written, for example because the disk is full, this is reported, and the other checkpoints are
        left as they are.

        Args:
            step: number of meta-updates done.
            items: pytrees by name; each can be restored alone.
            score: the validation's score, by which the best checkpoint is selected, or UNVALIDATED.
            extra: values to store as JSON beside the arrays.

        Returns:
            Whether the checkpoint was written.
        """
        saves = {name: ocp.args.StandardSave(jax.tree.map(_stored, tree)) for name, tree in items.items()}
        args = ocp.args.Composite(**saves, extra=ocp.args.JsonSave({"format": FORMAT, **extra}))
        try:
            with _silenced():
                self._manager.save(step, args=args, metrics={"success": score})
                self._manager.wait_until_finished()
            if parallel.is_first_host():
                _write_checksums(self.folder / str(step))
        except Exception as error:  # several libraries raise their own types of errors, from their own threads
            self._manager = self._open(self.folder)
            if self.latest == step and not _damage(self.folder / str(step)):
                self._report(f"checkpoint of step {step}: its checksums could not be written: {error}")
                return True
            kept = "there is none before it" if self.latest is None else f"the last good one is of step {self.latest}"
            self._report(f"checkpoint of step {step} could not be written, {kept}: {_reason(error)}")
            return False
        return True

    def restore(self, step: int, like: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reads a checkpoint.

        Args:
            step: the checkpoint's step.
            like: the items to restore, by name: pytrees of arrays or shapes with the same structure.

        Returns:
            The items and the extra values.

        Raises:
            FileError: if the checkpoint does not hold these items.
        """
        restores = {name: ocp.args.StandardRestore(jax.tree.map(_on_host, tree)) for name, tree in like.items()}
        try:
            restored = self._manager.restore(step, args=ocp.args.Composite(**restores, extra=ocp.args.JsonRestore()))
            for name, tree in restores.items():
                jax.tree_util.tree_map_with_path(functools.partial(_check_shape, name), tree.item, restored[name])
        except Exception as error:  # Orbax and TensorStore raise many types of errors
            reason = f"{type(error).__name__}: {str(error).strip().splitlines()[0]}"
            expected = f"what this version of milx writes; it is of {self._origin(step)}"
            raise FileError(f"{self.folder / str(step)}: cannot be restored, expected {expected} ({reason})") from error
        extra = restored["extra"]
        if not isinstance(extra, dict):
            raise FileError(f"{self.folder / str(step)}: extra: got {extra!r:.100}, expected values by name")
        if (number := extra.pop("format", 1)) != FORMAT:  # the first had no number
            got = f"got format {number!r:.100}, expected {FORMAT}"
            raise FileError(f"{self.folder / str(step)}: {got}: it may have been made by a later milx")
        # Orbax commits arrays to a device. Programs that were compiled for uncommitted arrays would be compiled again.
        free = lambda like, x: jnp.asarray(np.asarray(x) if like.size else np.zeros(like.shape, like.dtype))  # noqa: E731
        return {name: jax.tree.map(free, like[name], restored[name]) for name in like}, extra

    def replace(self, step: int, items: dict[str, Any], score: float, extra: dict[str, Any]) -> bool:
        """Writes the checkpoint of a step again, for example with its score; a copy is kept until this is done.

        The arguments and the result are those of `save`.
        """
        copied = True
        if parallel.is_first_host():
            copy = self._replaced / str(step)
            try:
                files.remove(copy)
                with files.creating(copy) as partial:
                    shutil.copytree(self.folder / str(step), partial, dirs_exist_ok=True)
            except (FileError, shutil.Error) as error:
                copied = False
                self._report(f"checkpoint of step {step} could not be written again: {error}")
        if not parallel.on_all_hosts(copied):
            return False
        self._manager.delete(step)
        written = self.save(step, items, score, extra)
        if parallel.is_first_host():
            if written:
                self._forget(copy)
            else:
                self._put_back()
        parallel.wait_for_all()
        if not written:
            self._manager = self._open(self.folder)
        return written

    def score(self, step: int) -> float:
        """Returns the score of a checkpoint's validation, or UNVALIDATED."""
        return self._manager.metrics(step)["success"]

    def close(self) -> None:
        """Stops Orbax's threads and deletes temporary files."""
        self._manager.close()
        if self._view:
            self._view.cleanup()

    def _origin(self, step: int) -> str:
        """Returns the versions of the software that wrote a checkpoint, as text for a message."""
        try:
            extra = self._manager.restore(step, args=ocp.args.Composite(extra=ocp.args.JsonRestore()))["extra"]
            return " and ".join(f"{name} {version}" for name, version in extra["versions"].items())
        except Exception:  # this is only for a message about an earlier error
            return "an unknown version"

    def _open(self, folder: pathlib.Path) -> ocp.CheckpointManager:
        keep = policies.AnyPreservationPolicy(
            [policies.LatestN(2), policies.BestN(get_metric_fn=lambda metrics: metrics["success"], n=1)]
        )
        options = ocp.CheckpointManagerOptions(
            preservation_policy=keep,
            best_fn=lambda metrics: metrics["success"],
            create=not self._read_only,
            enable_async_checkpointing=False,  # its threads keep a process alive whose disk has failed
            read_only=self._read_only,
        )
        return ocp.CheckpointManager(folder, options=options)

    @property
    def _replaced(self) -> pathlib.Path:
        """The folder of the copies that `replace` makes."""
        return self.folder.parent / "replaced"

    def _put_back(self) -> None:
        """Finishes a `replace`: moves copies of missing or damaged checkpoints back and deletes all others."""
        files.remove_leftovers(self._replaced)
        for copy in self._replaced.glob("[0-9]*"):
            target = self.folder / copy.name
            if target.is_dir() and not _damage(target):
                self._forget(copy)
                continue
            if target.is_dir():
                _move_aside(target)
            files.move(copy, target)
        with contextlib.suppress(OSError):  # the folder does not exist or is not empty
            self._replaced.rmdir()

    def _forget(self, copy: pathlib.Path) -> None:
        """Removes a copy that is no longer needed."""
        with contextlib.suppress(FileError):  # the next start tries again
            files.remove(copy)
        with contextlib.suppress(OSError):
            self._replaced.rmdir()

    def _without_damaged(self) -> pathlib.Path:
        """Returns a folder that holds only undamaged checkpoints.

        It is the folder of the checkpoints, from which damaged ones have been moved. If that folder is read-only and
        holds damaged checkpoints, it is a temporary folder with links to the others.
        """
        if not self._read_only:
            if parallel.is_first_host():
                self._put_back()
            parallel.wait_for_all()
        steps = sorted(path for path in self.folder.glob("*") if path.name.isdigit())
        damage = {path: problem for path in steps if (problem := _damage(path)) and path.is_dir()}
        steps = [path for path in steps if path.is_dir()]  # a training process may delete some at the same time
        for path, problem in damage.items():
            self._report(f"checkpoint {path} is damaged and not used: {problem}")
        if damage and len(damage) == len(steps):
            raise ValueError(f"checkpoints: all in {self.folder} are damaged, expected at least one that is not")
        if self._read_only and damage:
            self._view = tempfile.TemporaryDirectory()
            for path in set(steps) - set(damage):
                (pathlib.Path(self._view.name) / path.name).symlink_to(path)
            return pathlib.Path(self._view.name)
        if not self._read_only:
            parallel.wait_for_all()  # until every host has read the folder
            if parallel.is_first_host():
                for path in damage:
                    _move_aside(path)
                for path in set(steps) - set(damage):
                    # It may be from an earlier version of milx, or from a process that was killed before this.
                    if not (path / _CHECKSUMS).is_file():
                        _write_checksums(path)
            parallel.wait_for_all()
        return self.folder


@contextlib.contextmanager
def _silenced() -> Iterator[None]:
    """Keeps Orbax from logging the tracebacks of errors that it raises as well, for good if it has raised one.

    Threads of a save that has failed go on, and would log more when the process ends, after its last message.
    """
    before = logging.get_verbosity()
    logging.set_verbosity(logging.FATAL)
    yield
    logging.set_verbosity(before)


def _reason(error: BaseException) -> str:
    """Puts an error in one line: that of the operating system, if it comes from one."""
    first: BaseException | None = error
    while first is not None and not isinstance(first, OSError):
        first = first.__cause__ or first.__context__
    return str(first or error).strip().splitlines()[0]


def _stored(x: Any) -> Any:
    """Replaces an array without entries, which Orbax cannot store, by an array with one entry."""
    return x if np.size(x) else np.zeros(1, x.dtype)


def _on_host(x: Any) -> np.ndarray:
    """Asks for an array on the host: Orbax would look for the devices that it was saved from, which may be others."""
    return np.zeros(x.shape if np.size(x) else 1, x.dtype)


def _check_shape(name: str, path: tuple, wanted: np.ndarray, x: np.ndarray) -> None:
    """Raises ValueError if an array was stored with another shape, which Orbax does not check on the host."""
    if wanted.shape != x.shape:
        raise ValueError(f"{name}{jax.tree_util.keystr(path)}: got the shape {x.shape}, expected {wanted.shape}")


def _damage(checkpoint: pathlib.Path) -> str | None:
    """Describes what is wrong with a checkpoint's files; returns None if they are undamaged.

    Raises:
        FileError: if they cannot be read now, which says nothing about what they hold.
    """
    if not (checkpoint / _METADATA).is_file():
        return f"{_METADATA} is missing"
    try:
        files.refuse_links(checkpoint)
        problem = _changed(checkpoint) if (checkpoint / _CHECKSUMS).is_file() else _unreadable(checkpoint)
        return problem or _bad_score(checkpoint)
    except FileError as error:
        if isinstance(error.__cause__, OSError) and not isinstance(error.__cause__, FileNotFoundError):
            raise
        return str(error)


def _changed(checkpoint: pathlib.Path) -> str | None:
    """Describes where a checkpoint does not match its checksums; returns None if it does."""
    expected = files.read_json(checkpoint / _CHECKSUMS)
    if not isinstance(expected, dict):
        return f"{_CHECKSUMS} holds no checksums"
    found = _checksums(checkpoint)
    for name in sorted(expected):
        if name not in found:
            return f"{name} is missing"
        if found[name] != expected[name]:
            return f"{name} has changed"
    return None if expected else f"{_CHECKSUMS} is empty"


def _bad_score(checkpoint: pathlib.Path) -> str | None:
    """Describes what is wrong with the score by which Orbax ranks a checkpoint; returns None if it is a number."""
    values = files.read_json(checkpoint / "metrics" / "metrics")
    score = values.get("success") if isinstance(values, dict) else None
    return None if isinstance(score, int | float) and abs(score) < 1e30 else f"its score is {score!r:.100}, no number"


def _unreadable(checkpoint: pathlib.Path) -> str | None:
    """Describes why a checkpoint without checksums cannot be read; returns None if it can."""
    files.read_json(checkpoint / "extra" / "metadata")
    with contextlib.closing(ocp.StandardCheckpointer()) as reader:
        for item in sorted(path.parent for path in checkpoint.glob("*/manifest.ocdbt")):
            try:
                reader.restore(item, jax.tree.map(_on_host, reader.metadata(item).item_metadata.tree))
            except Exception as error:  # Orbax and TensorStore raise many types of errors
                return f"{item.name} cannot be read ({type(error).__name__})"
    return None


def _checksums(checkpoint: pathlib.Path) -> dict[str, str]:
    paths = sorted(path for path in checkpoint.rglob("*") if path.is_file() and _CHECKSUMS not in path.name)
    return {str(path.relative_to(checkpoint)): files.sha256(path) for path in paths}


def _write_checksums(checkpoint: pathlib.Path) -> None:
    files.write_json(checkpoint / _CHECKSUMS, _checksums(checkpoint))


def _move_aside(checkpoint: pathlib.Path) -> None:
    aside = checkpoint.parent.parent / "damaged"
    target, number = aside / checkpoint.name, 1
    while target.exists():
        target, number = aside / f"{checkpoint.name}.{number}", number + 1
    files.move(checkpoint, target)
