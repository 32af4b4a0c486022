"""The policy that users work with: it is loaded from a run, adapted to a demonstration, and asked for actions."""

import dataclasses
import functools
import pathlib
from typing import Any

import jax
import numpy as np

from milx import envs, methods
from milx.config import assemble
from milx.config.registry import load_plugins
from milx.config.schema import GIVEN, Config
from milx.core import files
from milx.core.checkpoint import Checkpoints
from milx.core.files import FileError
from milx.data.cameras import fitted
from milx.data.dataset import spread
from milx.data.frames import in_chunks, previous_frames
from milx.data.goals import with_goals
from milx.methods import Method
from milx.methods.history import stacked
from milx.types import SPEC_FILE, Array, Demo, Memory, Observation, Params, Spec, TaskParams, by_field, from_fields


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """A trained method with its parameters.

        policy = milx.load("runs/reach")
        task_params = policy.adapt(policy.params, demo)
        action = policy.act(task_params, observation)

    Attributes:
        method: the method, which adapts and acts.
        spec: the sizes of observations and actions.
        params: the meta-learned parameters.
        config: the run's configuration.
    """

    method: Method
    spec: Spec
    params: Params
    config: Config

    def adapt(self, params: Params, demo: Demo) -> TaskParams:
        """Adapts to a task from one demonstration [T, ...] or several [K, T, ...]; the computation is jitted.

        Inside `jax.jit`, `jax.vmap` and `jax.grad` it is a pure function, and values are not checked. A policy that was
        trained on recorded demonstrations resamples the demonstrations to its `horizon` by selecting time steps.

        Args:
            params: `policy.params`.
            demo: images [..., T, H, W, 3] uint8, states [..., T, S] and actions [..., T, A], as NumPy or JAX arrays. Of
                several cameras, images are a dictionary by name; None for a policy that sees no pixels. NumPy images
                that are larger, with the same proportions, are shrunk as importers do.

        Returns:
            The parameters adapted to the task (`task_params`), for `act` and `step`.

        Raises:
            ValueError: for a field that is missing or has a wrong shape or type, an image for a policy that sees no
                pixels, a value that is not finite, or an action outside the environment's limits.
        """
        return self._adapt(params, self.prepared(demo))

    def prepared(self, demo: Demo) -> Demo:
        """Checks demonstrations, and makes of them [K, T, ...] what `Method.adapt` takes.

        Raises:
            ValueError: as `adapt`.
        """
        demo = check_demo(demo, self.spec, self.config.method.given)
        if demo.action is not None:
            demo = dataclasses.replace(demo, action=in_chunks(demo.action, self.config.method.chunk))
        if not self.config.recorded.path:
            return demo
        frames = spread(jax.tree.leaves(demo)[0].shape[1], self.horizon)
        before = previous_frames(frames, self.config.recorded.history)
        image, state = stacked(*jax.tree.map(lambda x: x[:, before], (demo.image, demo.state)))
        rest = jax.tree.map(lambda x: x[:, frames], dataclasses.replace(demo, image=None, state=None))
        return dataclasses.replace(rest, image=image, state=state)

    def act(self, task_params: TaskParams, observation: Observation) -> jax.Array:
        """Returns the action [A], in the environment's units, for one observation; the computation is jitted.

        Inside `jax.jit`, `jax.vmap` and `jax.grad` it is a pure function, and values are not checked.

        Raises:
            ValueError: for a field that is missing or has a wrong shape or type, an image for a policy that sees no
                pixels, or a value that is not finite, be it in the observation or in the action. Also if the policy has
                a memory, which needs `step`.
        """
        if jax.tree.leaves(self.initial_memory):
            raise ValueError("memory: missing, expected `Policy.step`: this policy remembers what it saw before")
        return self.step(task_params, observation, self.initial_memory)[0]

    def step(self, task_params: TaskParams, observation: Observation, memory: Memory) -> tuple[jax.Array, Memory]:
        """Returns the action, as `act` does, and the memory for the next time step; the computation is jitted.

        Args:
            task_params: the parameters that `adapt` returned.
            observation: what the policy sees.
            memory: `initial_memory` at the first time step of an episode, and then the memory that the previous call
                returned.

        Returns:
            The action [A] and the next memory.

        Raises:
            ValueError: for a field that is missing or has a wrong shape or type, an image for a policy that sees no
                pixels, or a value that is not finite, be it in the observation or in the action.
        """
        action, memory = self._step(task_params, check_observation(observation, self.spec), memory)
        if not isinstance(action, jax.core.Tracer) and not np.isfinite(np.asarray(action)).all():
            raise ValueError(
                f"action: got {action}, expected finite numbers: the observation, or what was learned of the "
                "task, is beyond what the policy can compute with"
            )
        return action, memory

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickles configuration, sizes and parameters; whoever loads them compiles the programs anew."""
        params = jax.tree.map(np.asarray, self.params)
        return _from_values, (assemble.to_dict(self.config), self.spec.to_dict(), params)

    @property
    def horizon(self) -> int:
        """T, the time steps of the demonstrations that it was trained on."""
        return self.config.recorded.horizon if self.config.recorded.path else envs.ENVS[self.config.env_name].horizon

    @functools.cached_property
    def initial_memory(self) -> Memory:
        """The memory at the start of an episode; empty for most policies."""
        with jax.ensure_compile_time_eval():  # arrays, even if a program that is being traced asks first
            return self.method.initial_memory(jax.random.key(0))

    @functools.cached_property
    def _adapt(self) -> Any:
        return jax.jit(self.method.adapt)

    @functools.cached_property
    def _step(self) -> Any:
        return jax.jit(self.method.act)


def _from_values(config: dict[str, Any], spec: dict[str, Any], params: Params) -> Policy:
    load_plugins()  # it may be a policy of another package's method
    settings, sizes = assemble.from_dict(config), Spec.from_dict(spec)
    return Policy(methods.make(settings, sizes), sizes, jax.tree.map(jax.numpy.asarray, params), settings)


def read_spec(path: pathlib.Path) -> Spec:
    """Reads the sizes of a policy in a JSON file.

    Raises:
        FileError: if the file cannot be read, or holds something else.
    """
    values = files.read_json(path)
    try:
        return Spec.from_dict(values)
    except (ValueError, RecursionError) as error:
        raise FileError(f"{path}: expected the sizes of a policy: {error}") from error


def load_run(run: str | pathlib.Path) -> Policy:
    """Loads the best policy of a run.

    Args:
        run: the run's folder, as `python -m milx.train` writes it.

    Raises:
        ValueError: if the folder holds no run, or the run has no checkpoint yet.
    """
    folder = pathlib.Path(run)
    path = folder / "config.json"
    if not path.is_file():
        raise ValueError(f"run: {folder} has no config.json, expected a folder written by `python -m milx.train`")
    config = assemble.read(path)
    spec = read_spec(folder / SPEC_FILE) if (folder / SPEC_FILE).is_file() else envs.of_config(config).spec
    method = methods.make(config, spec)
    checkpoints = Checkpoints(folder / "checkpoints", read_only=True)
    if checkpoints.best is None:
        raise ValueError(f"run: {folder} has no checkpoint yet")
    items, _ = checkpoints.restore(checkpoints.best, {"params": methods.params_like(method, spec)})
    return Policy(method, spec, items["params"], config)


def check_demo(demo: Demo, spec: Spec, given: str = GIVEN[0]) -> Demo:
    """Checks one demonstration [T, ...] or several [K, T, ...], and prepares them for `Method.adapt`.

    Args:
        demo: the demonstrations.
        spec: the sizes of observations and actions.
        given: the parts to keep, one of GIVEN.

    Returns:
        Demonstrations [K, T, ...] with only the parts that are `given`, and with goals if their states tell them.

    Raises:
        ValueError: if a field is not as expected; the message names it, its value and what was expected.
    """
    if not isinstance(demo, Demo):
        raise ValueError(f"demo: got {type(demo).__name__}, expected a milx.Demo")
    without_actions = "state" if spec.state_size else "image"
    leading = {"video+state+action": "action", "video+state": without_actions, "video": "image"}[given]
    axes = {"action": ("A",), "state": ("S",), "image": ("H", "W", "3")}[leading]
    shown = by_field(demo.image) if leading == "image" else {leading: getattr(demo, leading)}
    leading, value = next(iter(shown.items()), (leading, None))
    first = _as_array(f"demo.{leading}", value)
    lead = first.ndim - len(axes) - 1
    if lead not in (0, 1) or 0 in first.shape:
        size = ", ".join(axes)
        expected = f"[T, {size}] or [K, T, {size}] with at least one time step"
        raise ValueError(f"demo.{leading}: got shape {list(first.shape)}, expected {expected}")
    shape = first.shape[: lead + 1]
    checked = Demo(_check_image("demo", demo.image, shape, spec))
    if given != "video":
        state = _check_state("demo.state", demo.state, shape, spec)
        checked = dataclasses.replace(checked, state=state)
    if given == "video+state+action":
        checked = dataclasses.replace(checked, action=_check_action(demo.action, shape, spec))
    if not lead:
        checked = jax.tree.map(lambda x: x[None], checked)
    return with_goals(checked, spec.goal_indices, **spec.goal_rule)


def _check_action(value: Any, shape: tuple[int, ...], spec: Spec) -> Array:
    action = _check_vector("demo.action", value, (*shape, spec.action_size))
    if spec.action_range is None or isinstance(action, jax.core.Tracer):
        return action
    low, high = spec.action_range
    if outside := np.argwhere((action < low) | (action > high)).tolist():
        index = tuple(outside[0])
        limits = f"at least {low[index[-1]]} and at most {high[index[-1]]}"
        raise ValueError(f"demo.action: got {action[index]} at {index}, expected {limits}")
    return action


def check_observation(observation: Observation, spec: Spec) -> Observation:
    """Checks one observation.

    Raises:
        ValueError: if a field is not as expected; the message names it, its value and what was expected.
    """
    if not isinstance(observation, Observation):
        raise ValueError(f"observation: got {type(observation).__name__}, expected a milx.Observation")
    return Observation(
        image=_check_image("observation", observation.image, (), spec),
        state=_check_state("observation.state", observation.state, (), spec),
    )


def _as_array(field: str, value: Any) -> Any:
    if value is None:
        raise ValueError(f"{field}: missing, expected an array")
    try:
        return value if isinstance(value, jax.Array) else np.asarray(value)
    except ValueError as error:
        raise ValueError(f"{field}: got {type(value).__name__}, expected an array ({error})") from error


def _check_image(what: str, value: Any, lead: tuple[int, ...], spec: Spec) -> Any:
    """Checks the images of all cameras; `what` shows them."""
    wanted, value = by_field(spec.image_shape), fitted(value, spec.image_shape) if spec.image_shape else value
    if not wanted:
        if value is not None:
            raise ValueError(f"{what}.image: got {type(value).__name__}, expected None: this policy sees no pixels")
        return None
    if value is not None and set(by_field(value)) != set(wanted):
        got = f"the cameras {', '.join(sorted(value))}" if isinstance(value, dict) else type(value).__name__
        several = (
            f"a dictionary of {', '.join(spec.image_shape)}" if isinstance(spec.image_shape, dict) else "one array"
        )
        raise ValueError(f"{what}.image: got {got}, expected {several}")
    checked, given = {}, by_field(value)
    for name, size in wanted.items():
        checked[name] = _check_shape(f"{what}.{name}", given.get(name), (*lead, *size, 3))
        if checked[name].dtype != np.uint8:
            raise ValueError(f"{what}.{name}: got {checked[name].dtype}, expected uint8 in [0, 255]")
    return from_fields(checked)


def _check_state(field: str, value: Any, lead: tuple[int, ...], spec: Spec) -> Array:
    """Checks states; None is allowed if the policy uses no states, and becomes an empty array."""
    if value is None and not spec.state_size:
        return np.zeros((*lead, 0), np.float32)
    return _check_vector(field, value, (*lead, spec.state_size))


def _check_vector(field: str, value: Any, shape: tuple[int, ...]) -> Array:
    array = _check_shape(field, value, shape)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{field}: got {array.dtype}, expected real numbers")
    if isinstance(array, jax.core.Tracer):  # its values are not known yet
        return array.astype(np.float32)
    array = np.asarray(array, np.float32)
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise ValueError(f"{field}: got {array[index]} at {index}, expected finite numbers")
    return array


def _check_shape(field: str, value: Any, shape: tuple[int, ...]) -> Any:
    array = _as_array(field, value)
    if array.shape != shape:
        raise ValueError(f"{field}: got shape {list(array.shape)}, expected {list(shape)}")
    return array
