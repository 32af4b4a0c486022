"""Times images of the push-sized scene and of reach, in milx, in MJX-Warp and in MuJoCo's own renderer.

    python experiments/benchmarks/render.py

From poses (after forward kinematics) to RGB, first with shadows, which favors MJX-Warp since milx's kernel knows none,
then without. MJX-Warp needs the package warp-lang and a GPU. It refits its bounding volume hierarchy to new poses, and
is timed without that first, which favors it, too.
"""

import os

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # Warp needs memory in the same process

import functools
import itertools
import multiprocessing
import pathlib
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor

import common
import jax
import jax.numpy as jnp
import mujoco
import push_sized
from absl import app, flags
from mujoco import mjx

import milx
from milx import envs
from milx.core import platform
from milx.envs.base import Env
from milx.render.scene import Renderer, Scene, to_uint8


def random_scenes(env: Env, count: int) -> Scene:
    """Draws scenes of random states after forward kinematics, with a leading axis."""
    task = env.sample_task(jax.random.key(0), "train")

    def scene(key: jax.Array) -> Scene:
        data = mjx.kinematics(env.model, env.data(env.reset(key, task)))
        return env.renderer.scene(mjx.camlight(env.model, mjx.com_pos(env.model, data)))

    return jax.jit(jax.vmap(scene))(jax.random.split(jax.random.key(1), count))


def measure_warp(
    model: mujoco.MjModel,
    image_shape: tuple[int, int],
    qpos: jax.Array,
    mocap_pos: jax.Array,
    shadows: bool = False,
    refit: bool = True,
) -> tuple[float, None]:
    """Measures frames/s of MJX-Warp's batch renderer.

    Args:
        model: whose cameras are all drawn.
        image_shape: (H, W).
        qpos: [N, nq] of N scenes.
        mocap_pos: [N, nmocap, 3] of the same.
        shadows: whether lights cast shadows.
        refit: whether the bounding volume hierarchy is refitted for every batch of poses, or only for the first.
    """
    import warp  # noqa: F401  without it MJX fails later and says less

    mx, count = mjx.put_model(model, impl="warp"), len(qpos)

    def pose(qpos: jax.Array, mocap_pos: jax.Array) -> mjx.Data:
        data = mjx.make_data(model, impl="warp", naconmax=8 * count, njmax=64)
        return data.replace(qpos=qpos, mocap_pos=mocap_pos)

    data = jax.jit(jax.vmap(pose))(qpos, mocap_pos)
    data = jax.jit(jax.vmap(mjx.forward, in_axes=(None, 0)))(mx, data)
    height, width = image_shape
    context = mjx.create_render_context(
        mjm=model,
        nworld=count,
        cam_res=(width, height),
        use_textures=False,
        use_shadows=shadows,
        render_rgb=True,
        render_depth=False,
        enabled_geom_groups=[0, 1, 2],
    )

    def render(mx: mjx.Model, data: mjx.Data) -> jax.Array:
        data = mjx.refit_bvh(mx, data, context.pytree()) if refit else data
        return mjx.render(mx, data, context.pytree())[0]

    data = jax.jit(lambda mx, data: mjx.refit_bvh(mx, data, context.pytree()))(mx, data)
    compiled = jax.jit(render, compiler_options={"xla_gpu_graph_min_graph_size": 1})
    image = compiled(mx, data)
    if not jnp.any(image != image.ravel()[0]):
        raise RuntimeError("the image has one color only")
    return 1e3 * count / common.median_ms(compiled, mx, data), None


def measure_warp_in(env: Env, count: int, shadows: bool, refit: bool) -> tuple[float, None]:
    """Measures MJX-Warp's frames/s in random first states of an environment."""
    task = env.sample_task(jax.random.key(0), "train")
    states = jax.jit(jax.vmap(lambda key: env.reset(key, task)))(jax.random.split(jax.random.key(1), count))
    return measure_warp(env.mj_model, env.image_shape, states.qpos, states.mocap_pos, shadows, refit)


def measure_opengl(model: mujoco.MjModel, camera: str, image_shape: tuple[int, int], shadows: bool) -> float:
    """Measures frames/s of `mujoco.Renderer`."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    model.vis.quality.offsamples = 0  # one sample in a pixel, as milx
    with mujoco.Renderer(model, *image_shape) as renderer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows

        def render() -> object:
            renderer.update_scene(data, camera=camera)
            return renderer.render()

        return 1e3 / common.median_ms(render)


def measure_opengl_elsewhere(env: Env, shadows: bool) -> tuple[float, None]:
    """Measures the same in another process: without a display, OpenGL may abort."""
    os.environ.setdefault("MUJOCO_GL", "egl")  # for the other process only: where EGL is missing, MuJoCo does not load
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(measure_opengl, env.mj_model, env.camera, env.image_shape, shadows).result(), None


def draw_by_xla(renderer: Renderer, scene: Scene) -> jax.Array:
    """Draws what `pixels` does, by the reference on every device."""
    return to_uint8(renderer.render(scene).color)


def measure_milx(scenes: Scene, draw: Callable[[Scene], jax.Array]) -> tuple[float, float]:
    """Measures frames/s and GiB of a function from a scene to pixels, in scenes with a leading axis."""
    compiled = jax.jit(jax.vmap(draw)).lower(scenes).compile(platform.pixel_options())
    return 1e3 * len(scenes.cam_xpos) / common.median_ms(compiled, scenes), common.gib(compiled)


def measure_all(report: common.Report, env: Env, count: int, shadows: bool) -> None:
    """Adds all rows of an environment with or without shadows, `count` images at once."""
    (height, width), note = env.image_shape, f"{count} at once"
    name = f"{env.name}, {env.mj_model.ngeom} geoms, {width}x{height}{', shadows' if shadows else ''}"
    unit, scenes = "frames/s", random_scenes(env, count)
    renderer = Renderer(env.mj_model, env.camera, height, width, shadows=shadows)
    if not (common.accelerated() and shadows):
        report.measure(f"{name}: milx", unit, functools.partial(measure_milx, scenes, renderer.pixels), note)
    if common.accelerated():
        draw = functools.partial(draw_by_xla, renderer)
        report.measure(f"{name}: milx, XLA", unit, functools.partial(measure_milx, scenes, draw), note)
    warp = functools.partial(measure_warp_in, env, count, shadows)
    report.attempt(f"{name}: MJX-Warp, not refitted", unit, functools.partial(warp, refit=False), note)
    report.attempt(f"{name}: MJX-Warp", unit, functools.partial(warp, refit=True), note)
    opengl = functools.partial(measure_opengl_elsewhere, env, shadows)
    report.attempt(f"{name}: mujoco.Renderer", unit, opengl, "one by one")


def main(_: list[str]) -> None:
    """Measures and writes the JSON file."""
    milx.configure()
    report = common.Report("render", pathlib.Path(_OUT.value))
    count = _FRAMES.value or (64 if not common.accelerated() else 4096)
    for env, shadows in itertools.product((push_sized.PushSized(), envs.make("reach")), (True, False)):
        measure_all(report, env, count, shadows)


if __name__ == "__main__":
    _OUT = flags.DEFINE_string("out", str(common.RESULTS), "Folder of the JSON file.")
    _FRAMES = flags.DEFINE_integer(
        "frames", None, "Frames at once; 4,096 on an accelerator and 64 on a CPU by default."
    )
    app.run(main)
