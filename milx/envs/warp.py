"""Physics steps by MuJoCo Warp, MJX's other implementation, for rollouts that nobody differentiates.

MJX's implementation in JAX computes the contacts of all pairs of geoms in every world, and XLA compiles it for each
program anew. Warp computes those that there are, by kernels that are compiled once, and has no derivative. Both start
from the same `mjx.Model`, so that shapes, masses and friction may differ from world to world.

Warp keeps the contacts of all worlds in one array, so their number must be known. `jax.vmap` hides it from the function
that it maps; a rule of our own (`jax.custom_batching`) is told it.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jax.custom_batching import custom_vmap

from milx.core.mjx import mjx

_Leaves = tuple[jax.Array, ...]


class WarpPhysics:
    """Steps worlds of one MuJoCo model.

    Args:
        model: MuJoCo's model.
        contacts: the largest number of contacts in a world.
        constraints: the largest number of rows of its constraints.

    Raises:
        ValueError: if `warp-lang` is not installed, or the device is neither a GPU nor a CPU.
    """

    def __init__(self, model: mujoco.MjModel, contacts: int, constraints: int):
        try:
            import warp
        except ImportError as error:
            raise ValueError("env.physics: got 'warp', expected `pip install 'milx[warp]'` first") from error
        from mujoco.mjx.third_party.mujoco_warp import OverflowType

        if warp.config.log_level == warp.LOG_INFO:  # the default, which names every kernel that is loaded
            warp.config.log_level = warp.LOG_WARNING
        device = jax.local_devices()[0]
        if device.platform not in ("cpu", "gpu"):
            raise ValueError(f"env.physics: got 'warp' on a {device.platform}, expected an NVIDIA GPU or a CPU")
        self._mj_model, self._contacts, self._constraints = model, contacts, constraints
        self._model = mjx.put_model(model, device, impl="warp")
        # Models limit the solver's iterations on purpose, so reaching them is not worth a message; all pairs of geoms
        # are examined, since by bounding volumes of the shapes that the model was compiled with some would be missed.
        warned = OverflowType.ALL & ~(OverflowType.ITERATIONS | OverflowType.LS_ITERATIONS)
        self._options = self._model.opt._impl.replace(broadphase_filter=0, warn_overflow=warned)
        self._worlds = functools.cache(self._make_worlds)

    def advance(
        self, model: mjx.Model, x: jax.Array, mocap_pos: jax.Array, ctrl: jax.Array, substeps: int
    ) -> jax.Array:
        """Takes physics steps in one world; `jax.vmap` gives batches.

        Args:
            model: as MJX in JAX has it, with the shapes, masses and friction of this world.
            x: [nq + nv], positions and velocities.
            mocap_pos: [O, 3], of bodies that stand where the scene puts them (m).
            ctrl: [nu].
            substeps: how many.

        Returns:
            The next x [nq + nv], computed in float32.
        """
        leaves, structure = jax.tree.flatten(self._of(model))
        alone = (jnp.float32(each)[None] for each in (x, mocap_pos, ctrl))
        batched = (False,) * len(leaves) + (True,) * 3
        return self._worlds(structure, batched, substeps)(*leaves, *alone)[0].astype(x.dtype)

    def _of(self, model: mjx.Model) -> mjx.Model:
        """Returns Warp's model with the shapes, masses, friction, time step and iterations of MJX's in JAX."""
        own = self._model

        def taken(name: str) -> bool:
            """Tells whether both mean the same by an array of real numbers; bounding boxes have other shapes."""
            mine = getattr(own, name)
            return (
                isinstance(mine, jax.Array)
                and jnp.issubdtype(mine.dtype, jnp.floating)
                and mine.shape == getattr(model, name).shape
            )

        names = [field.name for field in dataclasses.fields(own) if taken(field.name)]
        options = model.opt.replace(_impl=self._options)
        changed = {name: getattr(model, name) for name in names} | {"opt": options}
        return own.replace(**jax.tree.map(_in_float32, changed))

    def _make_worlds(self, structure: Any, batched: tuple[bool, ...], substeps: int) -> Callable[..., jax.Array]:
        """Makes the function of the leaves of a model, and of x [N, nq + nv], mocap_pos and ctrl, to the next x.

        Leaves that are batched have a leading axis N.
        """

        @custom_vmap
        def worlds(*leaves: jax.Array) -> jax.Array:
            start = self._data(len(leaves[-1]))

            def step(leaves: _Leaves, x: jax.Array) -> jax.Array:
                *rest, _, mocap_pos, ctrl = leaves
                data = start.replace(
                    qpos=x[: self._mj_model.nq], qvel=x[self._mj_model.nq :], mocap_pos=mocap_pos, ctrl=ctrl
                )
                data = mjx.step(jax.tree.unflatten(structure, rest), data)
                return jnp.concatenate([data.qpos, data.qvel])

            steps = jax.vmap(step, in_axes=(tuple(0 if b else None for b in batched), 0))
            return jax.lax.scan(lambda x, _: (steps(leaves, x), None), leaves[-3], length=substeps)[0]

        @worlds.def_vmap
        def rule(size: int, mapped: list[bool], *leaves: jax.Array) -> tuple[jax.Array, bool]:
            count = leaves[-1].shape[1 if mapped[-1] else 0]
            both = tuple(b or m for b, m in zip(batched, mapped, strict=True))

            def flat(x: jax.Array, inner: bool, outer: bool) -> jax.Array:
                if not (inner or outer):
                    return x
                x = x if outer else x[None]
                x = x if inner else x[:, None]
                return jnp.broadcast_to(x, (size, count, *x.shape[2:])).reshape(size * count, *x.shape[2:])

            flattened = (flat(*each) for each in zip(leaves, batched, mapped, strict=True))
            after = self._worlds(structure, both, substeps)(*flattened)
            return after.reshape(size, count, -1), True

        return worlds

    def _data(self, worlds: int) -> mjx.Data:
        """Makes data with room for the contacts of so many worlds, whose content does not depend on their number."""

        def room_for(worlds: int) -> mjx.Data:
            sizes = {"naconmax": self._contacts * worlds, "njmax": self._constraints}
            return mjx.make_data(self._mj_model, impl="warp", **sizes)

        def widened(x: jax.Array, wanted: jax.ShapeDtypeStruct) -> jax.Array:
            return x if x.shape == wanted.shape else jnp.full(wanted.shape, x.ravel()[0], wanted.dtype)

        # Arrays for all contacts would be constants in the program; these, of the same number everywhere, are not.
        few, many = room_for(1), jax.eval_shape(lambda: room_for(worlds))
        return jax.tree.unflatten(jax.tree.structure(many), map(widened, jax.tree.leaves(few), jax.tree.leaves(many)))


def _in_float32(x: jax.Array) -> jax.Array:
    return x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x
