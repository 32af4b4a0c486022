"""Exported policies say what the policies say, in a process that has neither milx nor Flax nor MuJoCo."""

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import milx
from milx import envs, methods
from milx.config import assemble
from milx.config.assemble import make_config
from milx.deploy import standalone
from milx.deploy.policy import Policy
from milx.export import export
from milx.methods.whitening import Whitening

T = 50
PROGRAM = """
import json, sys
folder, inputs, outputs = sys.argv[1:]
sys.path.insert(0, folder)
import numpy as np
from policy import Policy
policy = Policy(folder)
arrays = dict(np.load(inputs))
demo = {name: arrays[name] for name in policy.sizes["adapt"]}
task_params = policy.adapt(**demo)
seen = [{name: arrays[f"seen_{name}"][i] for name in policy.sizes["act"]} for i in range(3)]
np.save(outputs, np.stack([policy.act(task_params, **one) for one in seen]))
print(json.dumps(sorted({name.split(".")[0] for name in sys.modules})))
"""


def make_policy(method="mil", mixed_precision=False, **settings):
    """Makes an untrained policy for small images, whose whitening is not the identity."""
    config = make_config("reach", method, "cpu")
    config.network.mixed_precision = mixed_precision
    config.env.image_shape, config.env.goal_step = (16, 20), 20
    config.network.filters, config.network.strides, config.network.fc_layers = (4, 4), (2, 2), (16,)
    if settings.get("given") == "video":
        config.network.learned_loss, config.network.hindsight_head = "linear", True
    for name, value in settings.items():
        assemble.assign(config, f"method.{name}", value)
    spec = envs.of_config(config).spec
    whitening = Whitening(jnp.full(8, 0.2), jnp.full(8, 2.0), jnp.full(2, 0.1), jnp.full(2, 0.3))
    made = methods.make(config, spec)
    return Policy(made, spec, jax.jit(made.init)(jax.random.key(0), whitening), config)


@pytest.mark.parametrize(
    ("arguments", "shots"),
    [
        ({}, 1),
        pytest.param({"given": "video", "inner_steps": 2}, 2, marks=pytest.mark.slow),
        pytest.param({"method": "lstm"}, 2, marks=pytest.mark.slow),
    ],
    ids=["mil", "from two videos alone, in hindsight", "lstm, two shots"],
)
def test_another_process_gets_the_same_actions(tmp_path, arguments, shots):
    policy, rng = make_policy(**arguments), np.random.default_rng(0)
    demo = milx.Demo(
        image=rng.integers(0, 256, (shots, T, 16, 20, 3), np.uint8),
        state=rng.normal(size=(shots, T, 8)).astype(np.float32),
        action=rng.uniform(-1, 1, (shots, T, 2)).astype(np.float32),
    )
    seen = {
        "image": rng.integers(0, 256, (3, 16, 20, 3), np.uint8),
        "state": rng.normal(size=(3, 8)).astype(np.float32),
    }
    given = {name: getattr(demo, name) for name in ("image", "state", "action")}
    task_params = policy.adapt(policy.params, demo)
    expected = [policy.act(task_params, milx.Observation(*each)) for each in zip(*seen.values(), strict=True)]

    folder = tmp_path / "out"
    export(policy, folder, shots)
    np.savez(tmp_path / "in.npz", **given, **{f"seen_{name}": value for name, value in seen.items()})
    command = [sys.executable, "-c", PROGRAM, folder, tmp_path / "in.npz", tmp_path / "out.npy"]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]
    assert not {"milx", "flax", "mujoco", "optax", "orbax"} & set(json.loads(done.stdout.splitlines()[-1]))
    found = np.load(tmp_path / "out.npy")
    np.testing.assert_allclose(found, np.stack(expected), atol=1e-5)
    assert np.abs(found[0] - found[1]).max() > 1e-4
    unadapted = policy.method.unadapted(policy.params)
    if unadapted is not None:
        assert (
            np.abs(policy.act(unadapted, milx.Observation(seen["image"][0], seen["state"][0])) - found[0]).max() > 1e-4
        )
    with pytest.raises(ValueError, match=r"out: .* exists, expected a folder that does not"):
        export(policy, folder)


def test_programs_are_for_cpu_and_cuda_and_other_inputs_are_refused(tmp_path):
    from jax import export as jax_export

    export(make_policy(), tmp_path / "out")
    for name in ("adapt", "act"):
        program = jax_export.deserialize(bytearray((tmp_path / "out" / f"{name}.bin").read_bytes()))
        assert set(program.platforms) == {"cpu", "cuda"}

    from milx.deploy import standalone

    policy, rng = standalone.Policy(tmp_path / "out"), np.random.default_rng(0)
    image, state = rng.integers(0, 256, (70, 16, 20, 3), np.uint8), rng.normal(size=(70, 8))
    action = rng.normal(size=(70, 2))
    task_params = policy.adapt(image=image, state=state, action=action)
    index = np.linspace(0, 69, 50).round().astype(int)
    same = policy.adapt(image=image[index][None], state=state[index][None], action=action[index][None])
    jax.tree.map(np.testing.assert_array_equal, task_params, same)
    for arguments, message in (
        (
            {"image": image, "state": state},
            r"fields: got \['image', 'state'\], expected \['action', 'image', 'state'\]",
        ),
        ({"image": image, "state": state[:, :7], "action": action}, r"state: got shape \[70, 7\], expected \[..., 8\]"),
        ({"image": image / 255, "state": state, "action": action}, "image: got float64, expected uint8"),
        ({"image": np.stack([image] * 2), "state": state, "action": action}, "image: got 2 demonstrations, expected 1"),
        ({"image": image[:60], "state": state, "action": action}, r"time steps: got \{.*\}, expected the same of all"),
        ({"image": image, "state": state, "action": action * np.nan}, "action: got values that are not finite"),
        ({"image": image[:0], "state": state, "action": action}, r"image: got shape \[0, 16, 20, 3\]"),
    ):
        with pytest.raises(ValueError, match=message):
            policy.adapt(**arguments)
    with pytest.raises(ValueError, match=r"state: got shape \[70, 8\], expected \[..., 8\]"):
        policy.act(task_params, image=image[0], state=state)


def test_what_a_gpu_s_machine_exports_a_cpu_runs(tmp_path, monkeypatch):
    """Exports as if there were a GPU, whose kernels no file can hold; bfloat16 rounds differently there."""
    policy, rng = make_policy(mixed_precision=True), np.random.default_rng(0)
    demo = {
        "image": rng.integers(0, 256, (T, 16, 20, 3), np.uint8),
        "state": rng.normal(size=(T, 8)).astype(np.float32),
        "action": rng.uniform(-1, 1, (T, 2)).astype(np.float32),
    }
    task_params = policy.adapt(policy.params, milx.Demo(**demo))
    seen = milx.Observation(demo["image"][0], demo["state"][0])
    expected = policy.act(task_params, seen)
    with monkeypatch.context() as patched:
        patched.setattr(jax, "default_backend", lambda: "gpu")
        export(policy, tmp_path / "out")
    exported = standalone.Policy(tmp_path / "out")
    found = exported.act(exported.adapt(**demo), image=seen.image, state=seen.state)
    np.testing.assert_allclose(found, expected, atol=0.02)
    assert np.abs(found - policy.act(policy.method.unadapted(policy.params), seen)).max() > 0.02


def test_a_file_that_is_not_the_exported_one_is_refused(tmp_path):
    """Changes one byte of every file, and removes it; policy.json says what the others must be."""
    folder = tmp_path / "exported"
    export(make_policy(), folder)
    for name in ("adapt.bin", "act.bin", "params.npz", "policy.json"):
        content = (folder / name).read_bytes()
        middle = content.index(b"inputs") if name == "policy.json" else len(content) // 2  # nobody checks its metadata
        (folder / name).write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])
        with pytest.raises(ValueError, match=rf"{name}: (has changed since the export|expected what the export)"):
            standalone.Policy(folder)
        (folder / name).unlink()
        with pytest.raises(ValueError, match=f"{name}: cannot be read: No such file or directory"):
            standalone.Policy(folder)
        (folder / name).write_bytes(content)
    values = json.loads((folder / "policy.json").read_text())
    for change in ({"format": 2}, {"inputs": 3, "sha256": []}, {"sha256": None}):
        (folder / "policy.json").write_text(json.dumps(values | change))
        with pytest.raises(ValueError, match=r"policy\.json: expected what the export of a policy writes"):
            standalone.Policy(folder)
    for program in ("adapt", "act"):
        inputs = json.loads(json.dumps(values["inputs"]))
        inputs[program]["state"][-1] += 1
        (folder / "policy.json").write_text(json.dumps(values | {"inputs": inputs}))
        with pytest.raises(ValueError, match=rf"policy\.json: {program}: got .*, expected .* which the program takes"):
            standalone.Policy(folder)


def test_an_exported_policy_never_returns_what_is_not_finite(tmp_path):
    export(make_policy(), tmp_path / "exported")
    policy = standalone.Policy(tmp_path / "exported")
    image = np.zeros((16, 20, 3), np.uint8)
    good, huge = ({"image": image, "state": np.full(8, value, np.float32)} for value in (0.0, 3e38))
    demo = {"image": np.zeros((T, 16, 20, 3), np.uint8), "state": np.zeros((T, 8)), "action": np.zeros((T, 2))}
    task_params = policy.adapt(**demo)
    assert np.isfinite(policy.act(task_params, **good)).all()
    with pytest.raises(ValueError, match=r"action: got \[.*\], expected finite numbers"):
        policy.act(task_params, **huge)
