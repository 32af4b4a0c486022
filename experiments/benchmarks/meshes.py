"""Draws the meshes of any MJCF: how many pixels agree with MuJoCo's rays, and frames/s in milx and in MJX-Warp.

    python experiments/benchmarks/meshes.py --mjcf=panda/robot.xml --mjcf=hand/reach.xml

A camera of its own looks at the model in random positions of its joints. Shadows and textures are off. The results are
written to meshes.json, or meshes-cpu.json without an accelerator.
"""

import render  # first: it sets how much memory JAX takes  # isort: skip

import functools
import pathlib

import common
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from absl import app, flags

import milx
from milx.render import Renderer
from milx.render.scene import Scene

SIZE = 128
"""Height and width of an image, in pixels."""
FOVY = 45.0
"""Vertical field of view (degrees)."""
POSES = 8
"""In how many of the positions pixels are compared."""
FEW = 4
"""Frames at once by XLA, which is slow."""
DEPTH = 1e-3
"""By what part of the model's extent depths of pixels that agree may differ."""


def load(path: str) -> mujoco.MjModel:
    """Reads a model, and gives it one camera that sees it all, instead of its own."""
    stat = mujoco.MjModel.from_xml_path(path).stat
    spec = mujoco.MjSpec.from_file(path)
    for camera in list(spec.cameras):
        spec.delete(camera)
    for material in spec.materials:
        material.textures = [""] * len(material.textures)
    back = np.array([1.0, -1.0, 0.6]) / np.linalg.norm([1.0, -1.0, 0.6])
    right = np.cross([0.0, 0.0, 1.0], back)
    axes = np.stack([right / np.linalg.norm(right), np.cross(back, right / np.linalg.norm(right)), back], axis=1)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, axes.ravel())
    position = stat.center + 0.75 * stat.extent / np.tan(np.deg2rad(FOVY / 2)) * back
    spec.worldbody.add_camera(name="benchmark", pos=position, quat=quat, fovy=FOVY)
    return spec.compile()


def positions(model: mujoco.MjModel, count: int) -> np.ndarray:
    """Draws joint positions [N, nq]: within the limits of hinges and slides, others as the model has them."""
    rng = np.random.default_rng(0)
    qpos = np.tile(model.qpos0, (count, 1))
    for joint in range(model.njnt):
        if model.jnt_type[joint] >= int(mujoco.mjtJoint.mjJNT_SLIDE) and model.jnt_limited[joint]:
            low, high = model.jnt_range[joint]
            qpos[:, model.jnt_qposadr[joint]] = rng.uniform(low, high, count)
    return qpos


def scenes_at(model: mujoco.MjModel, renderer: Renderer, qpos: np.ndarray) -> Scene:
    """Returns the scenes of joint positions [N, nq], with a leading axis."""
    data, scenes = mujoco.MjData(model), []
    for row in qpos:
        data.qpos = row
        mujoco.mj_forward(model, data)
        scenes.append(jax.tree.map(np.asarray, renderer.scene(data)))
    return jax.tree.map(lambda *rows: jnp.asarray(np.stack(rows)), *scenes)


def agreement(model: mujoco.MjModel, renderer: Renderer, qpos: np.ndarray, scenes: Scene) -> float:
    """Measures in which part of the pixels `render` sees what `mj_ray` sees: the geom, at the same depth."""
    frames = jax.jit(jax.vmap(renderer.render))(scenes)
    half = np.tan(np.deg2rad(FOVY / 2))
    edge = half * ((np.arange(SIZE) + 0.5) * 2 / SIZE - 1)
    x, y = np.meshgrid(edge, -edge)
    ahead = np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3)
    data, shown, same = mujoco.MjData(model), np.array([1, 1, 1, 0, 0, 0], np.uint8), []
    geom, depth = np.zeros(len(ahead), np.int32), np.zeros(len(ahead))
    for row, seen, away in zip(qpos, np.asarray(frames.geom_id), np.asarray(frames.depth), strict=True):
        data.qpos = row
        mujoco.mj_forward(model, data)
        rays = (ahead @ data.cam_xmat[0].reshape(3, 3).T).ravel()
        mujoco.mj_multiRay(
            model, data, data.cam_xpos[0], rays, shown, True, -1, geom, depth, None, len(ahead), mujoco.mjMAXVAL
        )
        near = (geom < 0) | (np.abs(np.where(np.isinf(away), 0, away).ravel() - depth) < DEPTH * model.stat.extent)
        same.append((seen.ravel() == geom) & near)
    return float(np.mean(same))


def main(_: list[str]) -> None:
    """Measures and writes the JSON file."""
    milx.configure()
    report = common.Report("meshes", pathlib.Path(_OUT.value))
    count = _FRAMES.value or (1024 if common.accelerated() else 4)
    note = f"{count} at once"
    for path in _MJCF.value:
        model = load(path)
        renderer = Renderer(model, "benchmark", SIZE, SIZE)
        shown = model.geom_dataid[(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH) & (model.geom_group < 3)]
        name = f"{pathlib.Path(path).parent.name}/{pathlib.Path(path).name}"
        name = f"{name}, {len(shown)} meshes, {model.mesh_facenum[shown].sum():,} triangles, {SIZE}x{SIZE}"
        qpos = positions(model, max(count, POSES))
        scenes = scenes_at(model, renderer, qpos)
        few, first, some = (jax.tree.map(lambda x, n=n: x[:n], scenes) for n in (FEW, POSES, count))
        share = agreement(model, renderer, qpos[:POSES], first)
        report.add(f"{name}: agrees with mj_ray", 100 * share, "% of the pixels", note=f"in {POSES} positions")
        draw = functools.partial(render.draw_by_xla, renderer)
        report.measure(
            f"{name}: milx, XLA", "frames/s", functools.partial(render.measure_milx, few, draw), f"{FEW} at once"
        )
        if common.accelerated():
            painted, drawn = (np.asarray(jax.jit(jax.vmap(f))(first), int) for f in (renderer.paint, draw))
            share = float(np.mean(np.abs(painted - drawn).max(axis=-1) <= 1))
            report.add(f"{name}: the kernel draws what XLA draws", 100 * share, "% of the pixels", note="to 1 of 255")
            report.measure(
                f"{name}: milx, kernel", "frames/s", functools.partial(render.measure_milx, some, renderer.paint), note
            )
        poses = jnp.asarray(qpos[:count], float), jnp.tile(jnp.asarray(mujoco.MjData(model).mocap_pos), (count, 1, 1))
        report.attempt(
            f"{name}: MJX-Warp",
            "frames/s",
            functools.partial(render.measure_warp, model, (SIZE, SIZE), *poses),
            note,
        )


if __name__ == "__main__":
    _MJCF = flags.DEFINE_multi_string("mjcf", None, "Files of models (repeat the flag).", required=True)
    _OUT = flags.DEFINE_string("out", str(common.RESULTS), "Folder of the JSON file.")
    _FRAMES = flags.DEFINE_integer("frames", None, "Frames at once; 1,024 on an accelerator and 4 on a CPU by default.")
    app.run(main)
