"""Draws all shapes, all containers and some textures of every family, validation in yellow and test in red.

python experiments/paper/contact_sheet.py docs
"""

import dataclasses
import pathlib
import sys
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import mujoco
import numpy as np

import milx
from milx.envs import shapes
from milx.envs.place import containers
from milx.envs.shapes import primitives
from milx.render import textures
from milx.render.scene import Renderer, Scene, to_uint8

COLORS = {"train": (0.35, 0.55, 0.8), "validation": (0.85, 0.7, 0.3), "test": (0.85, 0.4, 0.35)}
COLUMNS = 14
SHOWN = "teapot"
"""The shape that wears the textures."""
SIZE = 0.045
"""Its unit of length (m), of the middle of what push draws."""
_XML = """
<mujoco>
  <worldbody>
    <light directional="true" pos="0 0 3" dir="-0.5 0.4 -1" diffuse="0.6 0.6 0.6" specular="0.1 0.1 0.1"/>
    <camera name="camera" pos="0 -3.8 5.2" xyaxes="1 0 0 0 0.745 0.667" fovy="38"/>
    <geom type="plane" size="0 0 0.1" rgba="0.93 0.93 0.9 1"/>
    {geoms}
  </worldbody>
</mujoco>"""


def stage(slots: dict[str, int]) -> tuple[Renderer, Scene]:
    """Makes a renderer for things with these geoms, and a scene without any."""
    geoms = "".join(f'<geom type="{kind}" size="0.1 0.1 0.1"/>' * count for kind, count in slots.items())
    model = mujoco.MjModel.from_xml_string(_XML.format(geoms=geoms))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = Renderer(model, "camera", 96, 96, shadows=True)
    return renderer, renderer.scene(data)


def put(empty: Scene, geoms: primitives.Geoms | containers.Geoms, color: Sequence[float]) -> Scene:
    """Puts a thing on the plane, with its unit as the unit of length."""
    matrix = np.zeros((len(geoms.quat), 9))
    for row, quat in zip(matrix, geoms.quat, strict=True):
        mujoco.mju_quat2Mat(row, quat)
    seen = geoms.seen if isinstance(geoms, primitives.Geoms) else geoms.used
    rgba = np.concatenate([np.tile(color, (len(seen), 1)), seen[:, None]], axis=1)
    place = {"xpos": geoms.pos, "xmat": matrix.reshape(-1, 3, 3), "size": geoms.size, "rgba": rgba}
    fields = {f"geom_{key}": getattr(empty, f"geom_{key}").at[1:].set(value) for key, value in place.items()}
    return dataclasses.replace(empty, **fields)


def wear(scene: Scene, family: str, key: jax.Array) -> Scene:
    """Dresses the scene's thing in a texture of this family, drawn as `textures.draw` draws it but for the family."""
    drawn = textures.draw(key, "train")
    drawn = drawn._replace(
        family=jnp.asarray(list(textures.FAMILIES).index(family)), frame=drawn.frame.at[:, :3].multiply(SIZE)
    )
    num_geoms = len(scene.geom_size)
    worn = jax.tree.map(lambda x: jnp.zeros((num_geoms, *x.shape), x.dtype).at[1:].set(x), drawn)
    return dataclasses.replace(scene, texture=worn)


def draw(renderer: Renderer, scenes: list[Scene], titles: list[str], path: pathlib.Path) -> None:
    """Draws all scenes into one picture."""
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *scenes)
    images = jax.lax.map(lambda scene: to_uint8(renderer.render(scene).color), stacked)
    rows = -(-len(scenes) // COLUMNS)
    figure, axes = plt.subplots(rows, COLUMNS, figsize=(COLUMNS, 1.16 * rows), layout="constrained")
    for axis in axes.ravel():
        axis.axis("off")
    for axis, image, title in zip(axes.ravel(), np.asarray(images), titles, strict=False):
        axis.imshow(image)
        axis.set_title(title, fontsize=7, pad=2)
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main(folder: str) -> None:
    """Renders and saves shapes.png, containers.png and textures.png."""
    milx.configure()
    out = pathlib.Path(folder)
    renderer, empty = stage(primitives.SLOTS)
    made = {name: primitives.to_geoms(shape) for name, shape in shapes.SHAPES.items()}
    names = [(name, split) for split, names in shapes.BY_SPLIT.items() for name in names]
    scenes = [put(empty, made[name], COLORS[split]) for name, split in names]
    draw(renderer, scenes, [name.replace("_", " ") for name, _ in names], out / "shapes.png")

    families = [(name, split) for split, names in textures.BY_SPLIT.items() for name in names]
    keys = jax.random.split(jax.random.key(0), (len(families), COLUMNS))
    scenes = [
        wear(put(empty, made[SHOWN], COLORS[split]), name, key)
        for (name, split), row in zip(families, keys, strict=True)
        for key in row
    ]
    draw(renderer, scenes, [name for name, _ in families for _ in range(COLUMNS)], out / "textures.png")

    renderer, empty = stage(containers.SLOTS)
    names = [(name, split) for split, names in containers.BY_SPLIT.items() for name in names]
    scenes = [put(empty, containers.to_geoms(containers.CONTAINERS[name]), COLORS[split]) for name, split in names]
    draw(renderer, scenes, [name.replace("_", " ") for name, _ in names], out / "containers.png")


if __name__ == "__main__":
    main(sys.argv[1])
