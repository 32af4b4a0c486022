"""A policy that `python -m milx.export` wrote: JAX, its flatbuffers and NumPy are all that it needs.

from policy import Policy

policy = Policy("folder of the export")
task_params = policy.adapt(image=images, state=states, action=actions)  # [T, ...] or [K, T, ...]
while True:
    action = policy.act(task_params, image=camera(), state=robot())  # [A]
"""

import json
import pathlib

import jax
import jax.export
import jax.numpy as jnp
import numpy as np


class Policy:
    """What was learnt, and the two programs that use it.

    Args:
        folder: as the export left it.

    Attributes:
        sizes: shapes [K, T, ...] of what `adapt` wants, and [...] of what `act` wants, by field.
        params: what was learnt.
        initial_memory: what the policy remembers at the start of an episode; empty for most policies.
    """

    def __init__(self, folder):
        folder = pathlib.Path(folder)
        self.sizes = json.loads((folder / "policy.json").read_text())
        with np.load(folder / "params.npz", allow_pickle=False) as arrays:
            self.params, self.initial_memory = (
                [jnp.asarray(arrays[name]) for name in sorted(arrays) if name.startswith("memory") == of_memory]
                for of_memory in (False, True)
            )
        self._adapt, self._act = (
            jax.jit(jax.export.deserialize((folder / f"{name}.bin").read_bytes()).call) for name in ("adapt", "act")
        )

    def adapt(self, **demo):
        """Learns a task from one demonstration, or several of the same length.

        Args:
            **demo: "image" uint8 [T, H, W, 3], "state" [T, S] and "action" [T, A], as far as the policy wants them; T
                is any number of steps, of which as many as the policy wants are kept. With K demonstrations there is
                another axis in front.

        Returns:
            What `act` needs of the task.

        Raises:
            ValueError: for a field that is missing, not wanted, or of a wrong shape or type.
        """
        wanted = self.sizes["adapt"]
        values, lengths = {}, {}
        for name, value in self._checked(demo, wanted, lead=2).items():
            value = value.reshape(-1, *value.shape[-len(wanted[name]) + 1 :])
            shots, steps = wanted[name][:2]
            if len(value) != shots:
                raise ValueError(f"{name}: got {len(value)} demonstrations, expected {shots}")
            values[name] = value[:, np.linspace(0, value.shape[1] - 1, steps).round().astype(int)]
            lengths[name] = value.shape[1]
        if len(set(lengths.values())) > 1:
            raise ValueError(f"time steps: got {lengths}, expected the same of all fields")
        return self._adapt(self.params, values)

    def act(self, task_params, **observation):
        """The action [A] for one observation: "image" uint8 [H, W, 3] and "state" [S], as far as it wants them.

        Raises:
            ValueError: for a field that is missing, not wanted, or of a wrong shape or type; for a policy that
                remembers.
        """
        if self.initial_memory:
            raise ValueError("memory: missing, expected `step`: this policy remembers what it saw first")
        return self.step(task_params, self.initial_memory, **observation)[0]

    def step(self, task_params, memory, **observation):
        """The action, as in `act`, and what the policy remembers for the next observation.

        `memory` is `initial_memory` at the first time step of an episode, and then what the step before returned.

        Raises:
            ValueError: for a field that is missing, not wanted, or of a wrong shape or type.
        """
        return self._act(task_params, self._checked(observation, self.sizes["act"], lead=0), memory)

    @staticmethod
    def _checked(values, wanted, lead):
        if set(values) != set(wanted):
            raise ValueError(f"fields: got {sorted(values)}, expected {sorted(wanted)}")
        checked = {}
        for name, value in values.items():
            value, shape = np.asarray(value), tuple(wanted[name])
            entries = value.shape[value.ndim - len(shape) + lead :]
            if entries != shape[lead:] or value.ndim not in (len(shape), len(shape) - bool(lead)) or 0 in value.shape:
                raise ValueError(f"{name}: got shape {list(value.shape)}, expected [..., {str(list(shape[lead:]))[1:]}")
            if (value.dtype == np.uint8) != (name == "image"):
                raise ValueError(
                    f"{name}: got {value.dtype}, expected {'uint8' if name == 'image' else 'real numbers'}"
                )
            if not np.isfinite(value).all():
                raise ValueError(f"{name}: got values that are not finite")
            checked[name] = value if name == "image" else value.astype(np.float32)
        return checked
