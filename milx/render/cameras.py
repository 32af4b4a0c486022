"""Images of a model in one call, from one camera or several."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco

from milx.core.mjx import mjx
from milx.render.scene import Frame, Renderer


def render(
    model: mujoco.MjModel,
    data: mjx.Data | mujoco.MjData,
    camera: str | int | Sequence[str | int],
    height: int,
    width: int,
    *,
    mjx_model: mjx.Model | None = None,
    shadows: bool = False,
    max_triangles: int | None = None,
) -> Frame:
    """Renders color, depth and geom ids; may be used under `jax.jit`, `jax.vmap`, `jax.lax.scan` and `jax.grad`.

    Color has gradients with respect to colors and lights, of `mjx_model` for example; geometry has none. Every call
    prepares a `Renderer`, under `jax.jit` once for all calls of the compiled function; keep one yourself where you
    render without.

    Args:
        model: the model.
        data: a state after `kinematics`, `com_pos` and `camlight`, or after `forward` or `step`.
        camera: name or id of a perspective camera, or several.
        height: of an image, in pixels.
        width: of an image, in pixels.
        mjx_model: whose sizes, colors and lights count, see `Renderer.scene`; those of `model` by default.
        shadows: whether lights with `castshadow` throw hard shadows.
        max_triangles: to how many a mesh with more is simplified, as for `Renderer`; None to keep them all.

    Returns:
        The frame; of several cameras, all its arrays have a leading axis of them, in the order given.

    Raises:
        ValueError: no camera is given, or as `Renderer`.
    """
    if isinstance(camera, str | int):
        renderer = Renderer(model, camera, height, width, shadows=shadows, max_triangles=max_triangles)
        return renderer.render(renderer.scene(data, mjx_model))
    if not camera:
        raise ValueError("camera: got none, expected at least one")
    first = Renderer(model, camera[0], height, width, shadows=shadows, max_triangles=max_triangles)
    renderers = [first, *map(first.with_camera, camera[1:])]
    frames = [renderer.render(renderer.scene(data, mjx_model)) for renderer in renderers]
    return jax.tree.map(lambda *arrays: jnp.stack(arrays), *frames)
