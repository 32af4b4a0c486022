"""Export of a policy as two programs that run without milx, on CPU and CUDA, in a folder of five files.

adapt.bin, act.bin      the programs, serialized by `jax.export`; they need neither milx nor Flax nor MuJoCo
params.npz              the learned parameters with the whitening, and the memory at the start of an episode
policy.json             the shapes of the programs' inputs, and the SHA-256 of the other files
policy.py               a copy of `milx/deploy/standalone.py`, which loads the other files
"""

import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export as jax_export

from milx.config.schema import GIVEN
from milx.core import files
from milx.data.goals import with_goals
from milx.deploy import standalone
from milx.deploy.policy import Policy
from milx.meta.operations import portable
from milx.types import Demo, Observation, Params, Spec, by_field, from_fields, is_image

PLATFORMS = ("cpu", "cuda")


def export(policy: Policy, out: str | pathlib.Path, shots: int = 1) -> None:
    """Writes a policy's programs and parameters.

    Args:
        policy: a policy from `milx.load`.
        out: the folder to write; it must not exist.
        shots: K, the number of demonstrations that `adapt` takes.

    Raises:
        ValueError: if the folder exists or cannot be written.
    """
    folder = pathlib.Path(out)
    if folder.exists():
        raise ValueError(f"out: {folder} exists, expected a folder that does not")
    sizes = input_shapes(policy, shots)
    leaves, structure = jax.tree.flatten(policy.params)

    def learn(params: Params, demo: dict[str, jax.Array]) -> Params:
        shown = Demo(**_with_state(demo, policy.spec))
        spec = policy.spec
        shown = with_goals(shown, spec.goal_indices, **spec.goal_rule)
        return policy.method.adapt(params, shown)

    def adapt(leaves: list[jax.Array], demo: dict[str, jax.Array]) -> list[jax.Array]:
        return jax.tree.leaves(learn(jax.tree.unflatten(structure, leaves), demo))

    shapes = {
        name: {field: jax.ShapeDtypeStruct(tuple(shape), _dtype(field)) for field, shape in fields.items()}
        for name, fields in sizes.items()
    }
    task_params = jax.eval_shape(learn, policy.params, shapes["adapt"])
    task_structure = jax.tree.structure(task_params)
    memory, memory_structure = jax.tree.flatten(policy.initial_memory)

    def seen(observation: dict[str, jax.Array]) -> Observation:
        return Observation(**_with_state(observation, policy.spec))

    def act(
        leaves: list[jax.Array], observation: dict[str, jax.Array], memory: list[jax.Array]
    ) -> tuple[jax.Array, list[jax.Array]]:
        task_params = jax.tree.unflatten(task_structure, leaves)
        remembered = jax.tree.unflatten(memory_structure, memory)
        action, remembered = policy.method.act(task_params, seen(observation), remembered)
        return action, jax.tree.leaves(remembered)

    programs = {
        "adapt": _program(adapt, leaves, shapes["adapt"]),
        "act": _program(act, jax.tree.leaves(task_params), shapes["act"], memory),
    }
    arrays = {f"{i:04d}": np.asarray(leaf) for i, leaf in enumerate(leaves)}
    arrays |= {f"memory{i:04d}": np.asarray(leaf) for i, leaf in enumerate(memory)}
    header = {"format": standalone.FORMAT, "inputs": sizes, "chunk": policy.config.method.chunk}
    header["history"] = policy.config.recorded.history
    header["metadata"] = {name: getattr(policy.spec, name) for name in ("fps", "state_names", "action_names")}
    with files.creating(folder) as partial:
        for name, program in programs.items():
            files.write_bytes(partial / f"{name}.bin", program)
        files.write_arrays(partial / "params.npz", arrays, compress=False)
        digests = {path.name: files.sha256(path) for path in sorted(partial.iterdir())}
        files.write_json(partial / "policy.json", header | {"sha256": digests})
        files.write_bytes(partial / "policy.py", files.read_bytes(pathlib.Path(standalone.__file__).resolve()))


def input_shapes(policy: Policy, shots: int) -> dict[str, dict[str, list[int]]]:
    """Returns the shapes of the fields that "adapt" and "act" take, by program and field."""
    spec, config = policy.spec, policy.config
    seen = {"state": [spec.state_size]} if spec.state_size else {}
    seen |= {name: [*size, 3] for name, size in by_field(spec.image_shape).items()}
    shown = {name: [*size, config.recorded.history * each] for name, (*size, each) in seen.items()}
    shown["action"] = [config.method.chunk * spec.action_size]
    hidden: tuple[str, ...] = {GIVEN[0]: (), GIVEN[1]: ("action",), GIVEN[2]: ("action", "state")}[config.method.given]
    adapt = {name: [shots, policy.horizon, *shape] for name, shape in shown.items() if name not in hidden}
    return {"adapt": adapt, "act": seen}


def _with_state(fields: dict[str, jax.Array], spec: Spec) -> dict[str, Any]:
    """Joins the images of several cameras, and adds an empty state if the policy uses no states."""
    image = from_fields(fields)
    others = {name: value for name, value in fields.items() if not is_image(name)}
    if not spec.state_size:
        others["state"] = jnp.zeros((*jax.tree.leaves(image)[0].shape[:-3], 0))
    return {"image": image, **others}


def _dtype(field: str) -> Any:
    return np.uint8 if is_image(field) else np.float32


def _program(function: Any, *args: Any) -> bytes:
    shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), args)
    with portable():
        return bytes(jax_export.export(jax.jit(function), platforms=PLATFORMS)(*shapes).serialize())
