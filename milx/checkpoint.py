"""Checkpoints through Orbax: written in the background, the latest and the best kept."""

import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers as policies


class Checkpoints:
    """The checkpoints of a run.

    Args:
        folder: where they lie; made if missing.
        read_only: look only, never write.
    """

    def __init__(self, folder: pathlib.Path, read_only: bool = False):
        keep = policies.AnyPreservationPolicy(
            [policies.LatestN(2), policies.BestN(get_metric_fn=lambda metrics: metrics["success"], n=1)]
        )
        options = ocp.CheckpointManagerOptions(
            preservation_policy=keep,
            best_fn=lambda metrics: metrics["success"],
            create=not read_only,
            read_only=read_only,
        )
        self._manager = ocp.CheckpointManager(folder.absolute(), options=options)

    @property
    def latest(self) -> int | None:
        """Step of the newest checkpoint; None if there is none."""
        return self._manager.latest_step()

    @property
    def best(self) -> int | None:
        """Step of the checkpoint with the highest validation success; None if there is none."""
        return self._manager.best_step()

    def save(self, step: int, items: dict[str, Any], success: float, extra: dict[str, Any]) -> None:
        """Writes pytrees of arrays in the background.

        Args:
            step: meta-updates done.
            items: pytrees by name; each can be restored alone.
            success: validation success, by which the best checkpoint is chosen.
            extra: numbers to restore beside the arrays, as JSON.
        """
        saves = {name: ocp.args.StandardSave(tree) for name, tree in items.items()}
        args = ocp.args.Composite(**saves, extra=ocp.args.JsonSave(extra))
        self._manager.save(step, args=args, metrics={"success": success})

    def restore(self, step: int, like: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Reads a checkpoint.

        Args:
            step: which.
            like: the items to restore, as pytrees of arrays or shapes with their structure.

        Returns:
            The items and the extra numbers.
        """
        restores = {name: ocp.args.StandardRestore(tree) for name, tree in like.items()}
        restored = self._manager.restore(step, args=ocp.args.Composite(**restores, extra=ocp.args.JsonRestore()))
        # Orbax pins arrays to the device that they come to, and a program compiled for free ones would compile again.
        items = {name: jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), restored[name]) for name in like}
        return items, restored["extra"]

    def close(self) -> None:
        """Waits until everything is written."""
        self._manager.wait_until_finished()
        self._manager.close()
