"""MuJoCo's two-dimensional textures on meshes that have texture coordinates.

At the coordinates (s, t) of a surface a texture of h rows and w columns shows the bilinear interpolation of its texels,
of which row i and column j lies at s = (j + 1/2) / w and t = (i + 1/2) / h. It repeats itself with a period of 1 in
both directions, and multiplies the color that the lights give the geom, at most 1. MuJoCo's renderer differs in what
follows: it takes textures in sRGB (`colorspace`) for what they are, shows no textures of one channel, and has smaller
versions of a texture for where it is seen from far away, where fine ones flicker here.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from milx.render.raycast import Vector


class Images(NamedTuple):
    """The textures of a model, one after the other, and which one a geom has; G geoms, P pixels.

    Attributes:
        texel: [N, 3] uint8 RGB, row by row.
        begin: [G] int32, the first texel of a geom's texture.
        size: [G, 2] int32, h and w; zero for geoms without a texture.
    """

    texel: np.ndarray
    begin: np.ndarray
    size: np.ndarray


def of_model(model: mujoco.MjModel, geoms: np.ndarray) -> Images | None:
    """Collects the textures of some geoms, which are meshes, each texture once; None if no geom shows one."""
    texels: list[np.ndarray] = []
    begin, size = np.zeros(model.ngeom, np.int32), np.zeros((model.ngeom, 2), np.int32)
    begins: dict[int, int] = {}
    for geom in geoms:
        texture = _texture(model, int(geom))
        if texture is None:
            continue
        if texture not in begins:
            begins[texture] = sum(map(len, texels))
            texels.append(_texels(model, texture))
        begin[geom], size[geom] = begins[texture], (model.tex_height[texture], model.tex_width[texture])
    return Images(np.concatenate(texels), begin, size) if texels else None


def _texture(model: mujoco.MjModel, geom: int) -> int | None:
    """Finds the two-dimensional texture of a mesh that has texture coordinates."""
    material = model.geom_matid[geom]
    if material < 0 or model.mesh_texcoordadr[model.geom_dataid[geom]] < 0:
        return None
    texture = int(model.mat_texid[material, int(mujoco.mjtTextureRole.mjTEXROLE_RGB)])
    flat = texture >= 0 and int(model.tex_type[texture]) == int(mujoco.mjtTexture.mjTEXTURE_2D)
    return texture if flat else None


def _texels(model: mujoco.MjModel, texture: int) -> np.ndarray:
    channels, first = model.tex_nchannel[texture], model.tex_adr[texture]
    count = model.tex_height[texture] * model.tex_width[texture]
    values = model.tex_data[first : first + channels * count].reshape(count, channels)
    return np.broadcast_to(values, (count, 3)) if channels == 1 else values[:, :3]


def mix(images: Images, rgb: Vector, geom_id: jax.Array, texcoord: Vector) -> Vector:
    """Multiplies colors by those of the textures.

    Args:
        images: the textures.
        rgb: three [P] arrays.
        geom_id: [P] int32, the geom that is seen.
        texcoord: s and t there, two [P] arrays; any finite numbers for geoms without a texture.

    Returns:
        Three [P] arrays.
    """
    texel = jnp.asarray(images.texel)
    begin, (height, width) = jnp.asarray(images.begin)[geom_id], jnp.asarray(images.size)[geom_id].T
    rows, columns = jnp.maximum(height, 1), jnp.maximum(width, 1)
    x, y = texcoord[0] * columns - 0.5, texcoord[1] * rows - 0.5
    left, top = jnp.floor(x), jnp.floor(y)
    shown = jnp.zeros((*x.shape, 3), x.dtype)
    for down, across in ((0, 0), (0, 1), (1, 0), (1, 1)):
        weight = jnp.where(down, y - top, 1 - y + top) * jnp.where(across, x - left, 1 - x + left)
        row, column = (top.astype(jnp.int32) + down) % rows, (left.astype(jnp.int32) + across) % columns
        shown += weight[:, None] * texel[begin + row * columns + column] / 255
    return tuple(jnp.where(height > 0, color * shown[:, i], color) for i, color in enumerate(rgb))
