"""Draws all shapes of milx.envs.shapes, validation in yellow and test in red, into one image.

python experiments/contact_sheet.py docs/shapes.png
"""

import dataclasses
import pathlib
import sys

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import mujoco
import numpy as np

from milx.envs.shapes import SHAPES, SPLITS
from milx.envs.shapes.primitives import SLOTS, to_geoms
from milx.render.scene import Renderer, Scene, to_uint8

COLORS = {"train": (0.35, 0.55, 0.8), "validation": (0.85, 0.7, 0.3), "test": (0.85, 0.4, 0.35)}
_XML = f"""
<mujoco>
  <worldbody>
    <light directional="true" pos="0 0 3" dir="-0.5 0.4 -1" diffuse="0.6 0.6 0.6" specular="0.1 0.1 0.1"/>
    <camera name="camera" pos="0 -3.8 5.2" xyaxes="1 0 0 0 0.745 0.667" fovy="38"/>
    <geom type="plane" size="0 0 0.1" rgba="0.93 0.93 0.9 1"/>
    {"".join(f'<geom type="{kind}" size="0.1 0.1 0.1"/>' * count for kind, count in SLOTS.items())}
  </worldbody>
</mujoco>"""


def main(path: str) -> None:
    """Renders and saves."""
    model = mujoco.MjModel.from_xml_string(_XML)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = Renderer(model, "camera", 96, 96, shadows=True)
    empty = renderer.scene(data)

    def scene(name: str, split: str) -> Scene:
        geoms = to_geoms(SHAPES[name])
        matrix = np.zeros((len(geoms.quat), 9))
        for row, quat in zip(matrix, geoms.quat, strict=True):
            mujoco.mju_quat2Mat(row, quat)
        rgba = np.concatenate([np.tile(COLORS[split], (len(geoms.seen), 1)), geoms.seen[:, None]], axis=1)
        place = {"xpos": geoms.pos, "xmat": matrix.reshape(-1, 3, 3), "size": geoms.size, "rgba": rgba}
        fields = {f"geom_{key}": getattr(empty, f"geom_{key}").at[1:].set(value) for key, value in place.items()}
        return dataclasses.replace(empty, **fields)

    names = [(name, split) for split, names in SPLITS.items() for name in names]
    scenes = jax.tree.map(lambda *x: jnp.stack(x), *(scene(*pair) for pair in names))
    images = jax.lax.map(lambda scene: to_uint8(renderer.render(scene).color), scenes)
    columns = 14
    figure, axes = plt.subplots(-(-len(names) // columns), columns, figsize=(14, 10.5), layout="constrained")
    for axis in axes.ravel():
        axis.axis("off")
    for axis, image, (name, _) in zip(axes.ravel(), np.asarray(images), names, strict=False):
        axis.imshow(image)
        axis.set_title(name.replace("_", " "), fontsize=7, pad=2)
    figure.savefig(pathlib.Path(path), dpi=110)


if __name__ == "__main__":
    main(sys.argv[1])
