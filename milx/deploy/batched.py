"""A policy in a batch of environments, with the names and layouts of LeRobot's evaluation loop, but without LeRobot."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from milx.data.cameras import name_of
from milx.deploy import standalone
from milx.deploy.policy import Policy
from milx.types import Demo, Memory, Observation, TaskParams, by_field, from_fields, is_image


class Batched:
    """A policy that acts in a batch of environments, in all of which the same task is to be done.

    Args:
        policy: what `milx.load` returns, or the `Policy` of an exported folder (`milx.deploy.standalone`).

    Raises:
        ValueError: if it is neither.
    """

    def __init__(self, policy: Any):
        self._policy, self._is_exported = policy, isinstance(policy, standalone.Policy)
        if self._is_exported:
            self._fields = tuple(policy.sizes["act"])
        elif not isinstance(policy, Policy):
            raise ValueError(f"policy: got {policy!r:.100}, expected a policy that `milx.load` or an export gives")
        else:
            self._fields = (*by_field(policy.spec.image_shape), *["state"] * bool(policy.spec.state_size))
        self._learned: tuple[TaskParams, ...] = ()
        self._memories: list[Memory] = []

    def reset(self, demo: Demo | None = None) -> None:
        """Begins new episodes: what was remembered of all environments is forgotten.

        Args:
            demo: one demonstration [T, ...] or several [K, T, ...] of the task of these and the following episodes;
                None if it is the same task as before.

        Raises:
            ValueError: as `adapt` of the policy, for a field that is missing or has a wrong shape, type or value.
        """
        if demo is not None:
            self._learned = (self._adapt(demo),)
        self._memories = []

    def act(self, batch: Mapping[str, np.ndarray]) -> np.ndarray:
        """Returns the actions [B, A], in the environment's units, for one time step of B environments.

        Args:
            batch: what `observations` takes, of the same environments in the same order as since the last `reset`.

        Raises:
            ValueError: if there was no demonstration, if the number of environments has changed since the last
                `reset`, or, as `observations` and `step` of the policy, for what an environment shows.
        """
        if not self._learned:
            raise ValueError("demo: missing, expected a call of `reset` with one before the first action")
        seen = observations(batch, self._fields)
        memories = self._memories or [self._policy.initial_memory] * len(seen)
        if len(seen) != len(memories):
            raise ValueError(f"batch: got {len(seen)} environments, expected {len(memories)} until the next `reset`")
        actions, after = [], []
        for number, (fields, memory) in enumerate(zip(seen, memories, strict=True)):
            try:
                action, memory = self._step(fields, memory)
            except ValueError as error:
                raise ValueError(f"environment {number}: {error}") from error
            actions.append(np.asarray(action))
            after.append(memory)
        self._memories = after
        return np.stack(actions)

    def _adapt(self, demo: Demo) -> TaskParams:
        if not self._is_exported:
            return self._policy.adapt(self._policy.params, demo)
        if not isinstance(demo, Demo):
            raise ValueError(f"demo: got {type(demo).__name__}, expected a milx.Demo")
        shown = {**by_field(demo.image), "state": demo.state, "action": demo.action}
        wanted = self._policy.sizes["adapt"]
        return self._policy.adapt(**{name: shown[name] for name in wanted if shown.get(name) is not None})

    def _step(self, fields: dict[str, np.ndarray], memory: Memory) -> tuple[Any, Memory]:
        if self._is_exported:
            return self._policy.step(*self._learned, memory, **fields)
        return self._policy.step(*self._learned, Observation(from_fields(fields), fields.get("state")), memory)


def observations(batch: Mapping[str, np.ndarray], fields: Sequence[str]) -> list[dict[str, np.ndarray]]:
    """Takes what a policy sees out of observations of B environments in LeRobot's layout.

    Args:
        batch: by LeRobot's names, "observation.state" [B, S], and images [B, 3, H, W], real numbers in [0, 1], of the
            cameras "observation.images.NAME", or of "observation.image". Other entries are ignored.
        fields: the names that the policy's observations have in milx: "state", and "image.NAME" for every camera, which
            may be "NAME_image" in the batch, as at import. The only camera of a policy is called "image", and may have
            any name in the batch, if no other is there.

    Returns:
        The fields of each of the B environments by name: the state [S] and images [H, W, 3] uint8.

    Raises:
        ValueError: for an entry that is missing, or has a wrong number of axes, type or value.
    """
    found = {}
    for field in fields:
        key = _key(batch, field)
        value = batch[key]
        if not isinstance(value, np.ndarray):
            raise ValueError(f"{key}: got {type(value).__name__}, expected an array")
        found[field] = _images(key, value) if is_image(field) else _vectors(key, value)
    sizes = {field: len(value) for field, value in found.items()}
    if len(set(sizes.values())) > 1:
        raise ValueError(f"batch: got {sizes} environments, expected the same number in all entries")
    environments = range(next(iter(sizes.values())))
    return [{field: value[i] for field, value in found.items()} for i in environments]


def _key(batch: Mapping[str, np.ndarray], field: str) -> str:
    """Finds LeRobot's name of a field of milx."""
    key = f"observation.{field.replace('image.', 'images.', 1)}"
    if key not in batch:
        cameras = [name for name in batch if name.startswith("observation.image")] if is_image(field) else []
        fitting = [name for name in cameras if field in ("image", f"image.{name_of(name)}")]
        if len(fitting) == 1:
            return fitting[0]
        got = ", ".join(name for name in batch if name.startswith("observation.")) or "no observations"
        expected = "this entry, or exactly one camera" if field == "image" else "an array"
        raise ValueError(f"{key}: missing, expected {expected}: got {got}")
    return key


def _vectors(key: str, value: np.ndarray) -> np.ndarray:
    if value.ndim != 2:
        raise ValueError(f"{key}: got shape {list(value.shape)}, expected [B, S]")
    return value


def _images(key: str, value: np.ndarray) -> np.ndarray:
    if value.ndim != 4 or value.shape[1] != 3 or 0 in value.shape:
        raise ValueError(f"{key}: got shape {list(value.shape)}, expected [B, 3, H, W]")
    if value.dtype.kind != "f":
        raise ValueError(f"{key}: got {value.dtype}, expected real numbers in [0, 1]")
    low, high = value.min(), value.max()
    if not (low >= 0 and high <= 1):  # also if one of them is not a number
        expected = "expected numbers in [0, 1]: milx normalizes images itself"
        raise ValueError(f"{key}: got numbers from {low} to {high}, {expected}")
    return np.rint(255 * value).astype(np.uint8).transpose(0, 2, 3, 1)
