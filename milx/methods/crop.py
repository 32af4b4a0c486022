"""Policies that see the middle of every image, and have learned from other parts of it (`milx.data.augment`)."""

import dataclasses
from typing import Any

import jax

from milx.methods.base import Wrapper
from milx.types import Demo, ImageShape, Memory, Observation, Params, TaskParams, by_field, from_fields


def cropped_shape(shape: ImageShape, crop: int) -> ImageShape:
    """Computes (H, W) of images of which `crop` pixels are cut off on every side, for all cameras.

    Raises:
        ValueError: if nothing of an image would be left, or there are no images.
    """
    if crop and shape is None:
        raise ValueError(f"recorded.crop: got {crop}, expected 0: this policy sees no pixels")
    for name, size in by_field(shape).items():
        if 2 * crop >= min(size):
            raise ValueError(f"recorded.crop: got {crop}, expected less than half of {name}, of {size[0]} x {size[1]}")
    return from_fields({name: (size[0] - 2 * crop, size[1] - 2 * crop) for name, size in by_field(shape).items()})


def middle(image: Any, crop: int) -> Any:
    """Cuts `crop` pixels off on every side of images [..., H, W, C]; of several cameras a dictionary by name."""
    return jax.tree.map(lambda x: x[..., crop : x.shape[-3] - crop, crop : x.shape[-2] - crop, :], image)


@dataclasses.dataclass(frozen=True, eq=False)
class Cropped(Wrapper):
    """A method that adapts to and acts on images [H - 2 c, W - 2 c, ...], the middle of those that it is given.

    Its loss is of images that have been cropped already, at random.

    Attributes:
        method: the method.
        crop: c, in pixels, at least 1.
    """

    crop: int

    def adapt(self, params: Params, demo: Demo) -> TaskParams:
        """As the method's, to the middle of the images."""
        return self.method.adapt(params, dataclasses.replace(demo, image=middle(demo.image, self.crop)))

    def act(self, task_params: TaskParams, observation: Observation, memory: Memory) -> tuple[jax.Array, Memory]:
        """As the method's, on the middle of the images."""
        seen = dataclasses.replace(observation, image=middle(observation.image, self.crop))
        return self.method.act(task_params, seen, memory)

    def initial_memory(self, key: jax.Array) -> Memory:
        """As the method's."""
        return self.method.initial_memory(key)
