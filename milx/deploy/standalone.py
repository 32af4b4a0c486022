"""A policy written by `python -m milx.export`. It needs only JAX, NumPy and flatbuffers.

from policy import Policy

policy = Policy("folder of the export")
task_params = policy.adapt(image=images, state=states, action=actions)  # [T, ...] or [K, T, ...]
while True:
    action = policy.act(task_params, image=camera(), state=robot())  # [A]
"""

import hashlib
import io
import json
import os
import pathlib

import jax
import jax.export
import jax.numpy as jnp
import numpy as np

FORMAT = 1
"""The number of the layout of policy.json."""


class Policy:
    """The learned parameters and the two programs that use them.

    Args:
        folder: the folder that the export wrote.

    Attributes:
        sizes: the shapes of the inputs, by field: [K, T, ...] for "adapt" and [...] for "act".
        metadata: "fps", "state_names" and "action_names" of the demonstrations, as far as they are known.
        chunk: the number of time steps whose actions "adapt" takes side by side, and the policy predicts at once.
        history: the number of time steps whose observations "adapt" takes side by side, and the policy sees at once.
        params: the learned parameters.
        initial_memory: the memory at the start of an episode; empty for most policies.

    Raises:
        ValueError: if a file is missing or not the one that was exported.
    """

    def __init__(self, folder: str | os.PathLike):
        folder = pathlib.Path(folder)
        header = _read_header(folder / "policy.json")
        self.sizes, digests, self.chunk, self.history = (
            header[name] for name in ("inputs", "sha256", "chunk", "history")
        )
        self.metadata = header.get("metadata", {})
        names = ("params.npz", "adapt.bin", "act.bin")
        params, *programs = (_read(folder / name, digests.get(name)) for name in names)
        with np.load(io.BytesIO(params), allow_pickle=False) as arrays:
            self.params, self.initial_memory = (
                [jnp.asarray(arrays[name]) for name in sorted(arrays) if name.startswith("memory") == of_memory]
                for of_memory in (False, True)
            )
        exported = [jax.export.deserialize(bytearray(program)) for program in programs]
        for name, program, after in zip(("adapt", "act"), exported, (0, len(self.initial_memory)), strict=True):
            _check_inputs(folder / "policy.json", name, self.sizes[name], program.in_avals, after)
        _check_lengths(folder / "policy.json", self.sizes, self.chunk, self.history)
        self._adapt, self._act = (jax.jit(program.call) for program in exported)

    def adapt(self, **demo: np.ndarray) -> list[jax.Array]:
        """Adapts to a task from one demonstration, or from several of the same length.

        Args:
            **demo: "image" uint8 [T, H, W, 3], of several cameras a dictionary by name, "state" [T, S] and "action"
                [T, A]; exactly those that `sizes["adapt"]` lists. T may be any number of time steps; the demonstration
                is resampled to the policy's number, at even intervals. With K > 1 demonstrations, all fields have a
                leading axis K.

        Returns:
            The parameters adapted to the task (`task_params`), for `act` and `step`.

        Raises:
            ValueError: for a field that is missing, not expected, or has a wrong shape or type, a value that is not
                finite, or another number of demonstrations than the policy was exported for.
        """
        values, lengths = {}, {}
        together = {name: self.chunk if name == "action" else self.history for name in self.sizes["adapt"]}
        wanted = {name: [*size, each // together[name]] for name, (*size, each) in self.sizes["adapt"].items()}
        for name, value in self._checked(demo, wanted, lead=2).items():
            value = value.reshape(-1, *value.shape[-len(wanted[name]) + 1 :])
            shots, steps = wanted[name][:2]
            if len(value) != shots:
                raise ValueError(f"{name}: got {len(value)} demonstrations, expected {shots}")
            lengths[name] = value.shape[1]
            frames = np.linspace(0, value.shape[1] - 1, steps).round().astype(int)[:, None]
            others = np.arange(together[name]) * (1 if name == "action" else -1)  # the next ones, or those before
            several = value[:, np.clip(frames + others, 0, value.shape[1] - 1)]
            values[name] = np.moveaxis(several, 2, -2).reshape(*self.sizes["adapt"][name])
        if len(set(lengths.values())) > 1:
            raise ValueError(f"time steps: got {lengths}, expected the same of all fields")
        return self._adapt(self.params, values)

    def act(self, task_params: list[jax.Array], **observation: np.ndarray) -> jax.Array:
        """Returns the action [A] for one observation.

        Args:
            task_params: the parameters that `adapt` returned.
            **observation: "image" uint8 [H, W, 3], of several cameras a dictionary by name, and "state" [S]; exactly
                those that `sizes["act"]` lists. Larger images of the same proportions are shrunk as they were when the
                demonstrations were imported.

        Raises:
            ValueError: for a field that is missing, not expected, or has a wrong shape or type, or a value that is not
                finite, also in the action. Also if the policy has a memory, which needs `step`.
        """
        if self.initial_memory:
            raise ValueError("memory: missing, expected `step`: this policy remembers what it saw before")
        return self.step(task_params, self.initial_memory, **observation)[0]

    def step(
        self, task_params: list[jax.Array], memory: list[jax.Array], **observation: np.ndarray
    ) -> tuple[jax.Array, list[jax.Array]]:
        """Returns the action, as `act` does, and the memory for the next time step.

        Args:
            task_params: the parameters that `adapt` returned.
            memory: `initial_memory` at the first time step of an episode, and then the memory that the previous call
                returned.
            **observation: as in `act`.

        Raises:
            ValueError: for a field that is missing, not expected, or has a wrong shape or type, or a value that is not
                finite, also in the action.
        """
        action, memory = self._act(task_params, self._checked(observation, self.sizes["act"], lead=0), memory)
        if not np.isfinite(np.asarray(action)).all():
            raise ValueError(
                f"action: got {action}, expected finite numbers: the observation, or what was learned of the "
                "task, is beyond what the policy can compute with"
            )
        return action, memory

    @staticmethod
    def _checked(values: dict, wanted: dict, lead: int) -> dict[str, np.ndarray]:
        if isinstance(cameras := values.get("image"), dict):
            values = {name: value for name, value in values.items() if name != "image"}
            values |= {f"image.{camera}": value for camera, value in cameras.items()}
        if set(values) != set(wanted):
            raise ValueError(f"fields: got {sorted(values)}, expected {sorted(wanted)}")
        checked = {}
        for name, value in values.items():
            value, shape = np.asarray(value), tuple(wanted[name])
            if name.partition(".")[0] == "image":
                value = _fitted(value, shape[-3:-1])
            entries = value.shape[value.ndim - len(shape) + lead :]
            if entries != shape[lead:] or value.ndim not in (len(shape), len(shape) - bool(lead)) or 0 in value.shape:
                raise ValueError(f"{name}: got shape {list(value.shape)}, expected [..., {str(list(shape[lead:]))[1:]}")
            is_image = name.partition(".")[0] == "image"
            if (value.dtype == np.uint8) != is_image:
                raise ValueError(f"{name}: got {value.dtype}, expected {'uint8' if is_image else 'real numbers'}")
            if not np.isfinite(value).all():
                raise ValueError(f"{name}: got values that are not finite")
            checked[name] = value if is_image else value.astype(np.float32)
        return checked


def _fitted(images: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Shrinks images [..., H, W, 3] uint8 to this (H, W) if they have its proportions and are larger."""
    if images.dtype != np.uint8 or images.ndim < 3 or 0 in images.shape or images.shape[-3] <= shape[0]:
        return images
    scale = shape[0] / images.shape[-3]
    if max(1, round(scale * images.shape[-2])) != shape[1]:
        return images
    rows, columns = (_areas(images.shape[axis], size) for axis, size in ((-3, shape[0]), (-2, shape[1])))
    shrunk = np.empty((*images.shape[:-3], *shape, 3), np.uint8)
    for index in np.ndindex(images.shape[:-3]):
        narrow = _rounded(np.einsum("wx,yxc->ywc", columns, images[index].astype(float), optimize=True))
        shrunk[index] = _rounded(np.einsum("hy,ywc->hwc", rows, narrow, optimize=True))
    return shrunk


def _areas(size: int, smaller: int) -> np.ndarray:
    """Returns the weights [smaller, size] of means over areas, as Pillow's box filter has them, times 2^22.

    Pillow may take the columns before the rows, which changes some pixels by one level.
    """
    scale = size / smaller
    center = (np.arange(smaller)[:, None] + 0.5) * scale
    pixel = np.arange(size)
    inside = (pixel >= np.floor(center - 0.5 * scale + 0.5)) & (pixel < np.floor(center + 0.5 * scale + 0.5))
    offset = (pixel - center + 0.5) / scale
    weight = inside & (offset > -0.5) & (offset <= 0.5)
    return np.floor(0.5 + 2.0**22 * weight / weight.sum(axis=1, keepdims=True))


def _rounded(sums: np.ndarray) -> np.ndarray:
    return np.clip(np.floor((sums + 2.0**21) / 2.0**22), 0, 255)


def _check_lengths(path: pathlib.Path, sizes: dict, chunk: int, history: int) -> None:
    """Raises ValueError if time steps of demonstrations do not hold a chunk of actions or a history of observations."""
    for name, (*_, size) in sizes["adapt"].items():
        field, count = ("chunk", chunk) if name == "action" else ("history", history)
        one = sizes["act"].get(name, [size // count])[-1]
        if size != count * one:
            raise ValueError(f"{path}: {field}: got {count}, expected {size / one:g}, as adapt takes {name} of {size}")


def _check_inputs(path: pathlib.Path, name: str, fields: dict, takes: tuple, after: int) -> None:
    """Raises ValueError if the shapes of a program's fields are not those that it takes; `after` inputs follow them."""
    takes = takes[-len(fields) - after :]
    named = {field: list(aval.shape) for field, aval in zip(sorted(fields), takes, strict=False)}
    if named != fields:
        raise ValueError(f"{path}: {name}: got {fields}, expected {named}, which the program takes")


def _read_header(path: pathlib.Path) -> dict:
    """Reads the shapes of the inputs, the SHA-256 of the other files, lengths of chunk and history, and metadata."""
    try:
        values = json.loads(_content(path))
        if values["format"] != FORMAT:
            raise ValueError(f"format: got {values['format']!r}, expected {FORMAT}")
        inputs, digests = values["inputs"], values["sha256"]
        if set(inputs) != {"adapt", "act"} or not all(isinstance(fields, dict) for fields in inputs.values()):
            raise ValueError(f"inputs: got {inputs!r:.100}, expected the fields of adapt and of act")
        if not isinstance(digests, dict):
            raise ValueError(f"sha256: got {digests!r:.100}, expected hashes by the names of files")
        lengths = {name: values.get(name, 1) for name in ("chunk", "history")}
        for name, length in lengths.items():
            if type(length) is not int or length < 1:
                raise ValueError(f"{name}: got {length!r:.100}, expected a whole number, at least 1")
        return values | lengths
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"{path}: expected what the export of a policy writes: {error!r:.200}") from error


def _read(path: pathlib.Path, digest: str | None) -> bytes:
    """Reads a file that must have this SHA-256."""
    content = _content(path)
    if hashlib.sha256(content).hexdigest() != digest:
        raise ValueError(f"{path}: has changed since the export, expected the file that was written then")
    return content


def _content(path: pathlib.Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read: {error.strerror}") from error
