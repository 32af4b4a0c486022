"""Work on one or many devices, of one or many hosts: a batch of tasks is split over them along its leading axis.

There is one mesh with one axis, "tasks". Parameters and demonstrations are on every device. Each device works on its
part of the tasks, and gradients are averaged over all devices. Random numbers do not depend on the number of devices.
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
    """Connects the hosts of the run, if there are several; must be called before anything runs on a device.

    The same command is started on each host. Under SLURM and on Cloud TPU pods the hosts find each other. Elsewhere all
    three arguments are needed.

    Args:
        coordinator: the first host's "address:port".
        processes: number of hosts.
        process: this host's number, from 0.

    Raises:
        ValueError: if the hosts cannot be found, for example because environment variables are not what SLURM sets.
    """
    tasks = os.environ.get("SLURM_STEP_NUM_TASKS", "1")
    if not tasks.isdecimal():
        raise ValueError(f"SLURM_STEP_NUM_TASKS: got {tasks!r}, expected a number, as SLURM sets it")
    pod = "," in os.environ.get("TPU_WORKER_HOSTNAMES", "")
    if not (coordinator or int(tasks) > 1 or pod):
        return
    try:
        jax.distributed.initialize(coordinator, processes, process)
    except Exception as error:  # what JAX finds in the environment decides on the type
        raise ValueError(f"hosts: cannot be joined, expected addresses that answer: {error!r:.300}") from error


def is_first_host() -> bool:
    """Returns whether this process writes the files that only one process may write."""
    return jax.process_index() == 0


def on_all_hosts(condition: bool) -> bool:
    """Returns whether the condition holds in every process; every process must call this function."""
    if jax.process_count() == 1:
        return condition
    return bool(multihost_utils.process_allgather(np.array(condition)).all())


def wait_for_all() -> None:
    """Waits until every process has called this function."""
    on_all_hosts(True)


def on_any_host(condition: bool) -> bool:
    """Returns whether the condition holds in at least one process; every process must call this function."""
    return not on_all_hosts(not condition)


@functools.cache
def mesh() -> Mesh:
    """Returns the mesh of all devices of all hosts."""
    return Mesh(jax.devices(), (AXIS,))


def num_devices() -> int:
    """Returns the number of devices that the tasks are split over."""
    return mesh().size


def round_up(size: int) -> int:
    """Rounds a number of tasks up to a multiple of the number of devices."""
    return -(-size // num_devices()) * num_devices()


def largest(x: jax.Array) -> jax.Array:
    """Returns the maximum of a scalar over the devices; must be called inside a function that `shard_tasks` runs."""
    return jax.lax.pmax(x, AXIS)


def replicate(tree: Any) -> Any:
    """Places arrays complete on every device, as the results of `shard_tasks` are, inside `jax.jit` or not.

    A program is compiled once more for arguments that are placed elsewhere, even if there is only one device.
    """
    return _place(tree, NamedSharding(mesh(), PartitionSpec()))


@functools.partial(jax.jit, static_argnums=1)
def _place(tree: Any, where: NamedSharding) -> Any:
    return jax.lax.with_sharding_constraint(tree, where)


def replicated_shapes(shapes: Any) -> Any:
    """Returns the shapes (of arrays or of `jax.eval_shape`) of what `replicate` has placed."""
    everywhere = NamedSharding(mesh(), PartitionSpec())

    def place(x: Any) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=everywhere, weak_type=x.weak_type)

    return jax.tree.map(place, shapes)


def shard_tasks(function: Callable[..., Any], *, shared: int = 0, average: bool = False) -> Callable[..., Any]:
    """Makes `function` run on every device with the device's part of the tasks.

    Args:
        function: a function of pytrees of arrays. It is called once on each device, inside `jax.jit`.
        shared: number of leading arguments that are the same on every device. The other arguments are split along
            their leading axis, whose size must be a multiple of `num_devices()`.
        average: return the mean of the devices' results instead of joining them along their leading axis.

    Returns:
        A function that takes the same arguments before they are split. Each device gets the complete result.
    """

    def on_each(*args: Any) -> Any:
        result = function(*args)
        return jax.lax.pmean(result, AXIS) if average else result

    everywhere, sharded = PartitionSpec(), PartitionSpec(AXIS)

    def call(*args: Any) -> Any:
        specs = tuple(everywhere if i < shared else sharded for i in range(len(args)))
        out = everywhere if average else sharded
        # Scans in milx start from constants, which the check of varying axes (check_vma) would reject.
        result = jax.shard_map(on_each, mesh=mesh(), in_specs=specs, out_specs=out, check_vma=False)(*args)
        return replicate(result)

    return call
