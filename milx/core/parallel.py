"""One or many devices, of one or many hosts: every batch of tasks is split over them along its leading axis.

There is one mesh with one axis, "tasks". Parameters and demonstrations are on every device; each device works on its
share of the tasks, and gradients are averaged over all. Nothing random depends on how many devices there are.
"""

import functools
import os
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "tasks"


def join_hosts(coordinator: str | None = None, processes: int | None = None, process: int | None = None) -> None:
    """Joins the other hosts of the run, if there are any; to be called before anything runs on a device.

    Each host starts the same command. Under SLURM and on Cloud TPU pods the hosts find each other; elsewhere each is
    told where the first one listens (`coordinator`, "address:port"), how many `processes` there are, and its number.
    """
    slurm = int(os.environ.get("SLURM_STEP_NUM_TASKS", "1")) > 1
    pod = "," in os.environ.get("TPU_WORKER_HOSTNAMES", "")
    if coordinator or slurm or pod:
        jax.distributed.initialize(coordinator, processes, process)


def is_first_host() -> bool:
    """Whether this process writes what only one must write."""
    return jax.process_index() == 0


def on_all_hosts(condition: bool) -> bool:
    """Whether the condition holds in every process; all have to ask."""
    if jax.process_count() == 1:
        return condition
    return bool(multihost_utils.process_allgather(np.array(condition)).all())


def wait_for_all() -> None:
    """Until every process is here."""
    on_all_hosts(True)


def on_any_host(condition: bool) -> bool:
    """Whether the condition holds in some process; all have to ask."""
    return not on_all_hosts(not condition)


@functools.cache
def mesh() -> Mesh:
    """All devices of all hosts."""
    return Mesh(jax.devices(), (AXIS,))


def num_devices() -> int:
    """How many devices share the tasks."""
    return mesh().size


def round_up(size: int) -> int:
    """The next number of tasks that the devices can share evenly."""
    return -(-size // num_devices()) * num_devices()


def largest(x: jax.Array) -> jax.Array:
    """The largest of the devices' scalars; to be called inside what `shard_tasks` runs."""
    return jax.lax.pmax(x, AXIS)


def shard_tasks(function: Callable[..., Any], *, shared: int = 0, average: bool = False) -> Callable[..., Any]:
    """Runs `function` on every device with its share of the tasks.

    Args:
        function: of pytrees of arrays. It is called once on each device, inside `jax.jit`.
        shared: the first so many arguments are the same on every device; the others are split along their leading
            axis, whose size must be a multiple of `num_devices()`.
        average: return the mean of the devices' results, instead of joining them along their leading axis.

    Returns:
        A function of the same arguments, whole. Its results are whole, too, and the same on every device.
    """

    def on_each(*args: Any) -> Any:
        result = function(*args)
        return jax.lax.pmean(result, AXIS) if average else result

    everywhere, split = PartitionSpec(), PartitionSpec(AXIS)

    def call(*args: Any) -> Any:
        specs = tuple(everywhere if i < shared else split for i in range(len(args)))
        out = everywhere if average else split
        # The rest of milx starts scans from constants, which the check of varying axes would refuse.
        result = jax.shard_map(on_each, mesh=mesh(), in_specs=specs, out_specs=out, check_vma=False)(*args)
        return jax.lax.with_sharding_constraint(result, NamedSharding(mesh(), everywhere))

    return call
