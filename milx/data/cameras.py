"""Images of one camera or of several: their names, and the sizes to which they are shrunk."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from PIL import Image

from milx.types import ImageShape


def name_of(source: str) -> str:
    """Names a camera by the last part of its source, without "_image"."""
    return source.rpartition(".")[2].removesuffix("_image")


def named(sources: str) -> dict[str, str]:
    """Names the cameras of sources that are separated by commas, as `name_of` does.

    Returns:
        The sources by name; a single one has the name "".

    Raises:
        ValueError: if two would have the same name.
    """
    listed = [source for source in sources.split(",") if source]
    if len(listed) == 1:
        return {"": listed[0]}
    names = [name_of(source) for source in listed]
    if len(set(names)) < len(names) or not all(names):
        raise ValueError(f"camera: got {sources}, which are called {', '.join(names)}; expected different names")
    return dict(zip(names, listed, strict=True))


def joined(of_camera: Mapping[str, Any]) -> Any:
    """Joins what belongs to cameras that `named` lists: a dictionary, the only camera's own, or None without any."""
    return of_camera.get("", dict(of_camera) or None)


def shrunk(shape: tuple[int, ...], height: int) -> tuple[int, int]:
    """Computes (H, W) of an image of this shape shrunk to at most `height` rows, in the same proportions."""
    scale = min(1.0, height / shape[0])
    return max(1, round(scale * shape[0])), max(1, round(scale * shape[1]))


def resized(images: Iterable[np.ndarray], shape: tuple[int, int]) -> Iterator[np.ndarray]:
    """Resizes images [H, W, 3] uint8 to `shape`; each yields means over areas where it shrinks."""
    for image in images:
        if image.shape[:2] != shape:
            image = np.asarray(Image.fromarray(image).resize(shape[::-1], Image.Resampling.BOX))
        yield image


def fitted(image: Any, shape: ImageShape) -> Any:
    """Shrinks images [..., H, W, 3] of all cameras to a policy's sizes, as importers do.

    What cannot have been shrunk to them stays as it is, for a check to refuse; cameras that the policy does not know
    are left out.
    """
    if shape is None:
        return None
    if isinstance(shape, dict):
        if not isinstance(image, dict):
            return image
        return {name: fitted(image[name], size) for name, size in shape.items() if name in image}
    fits = isinstance(image, np.ndarray) and image.dtype == np.uint8 and image.ndim >= 3 and image.shape[-1] == 3
    if not fits or image.shape[-3:-1] == shape or shrunk(image.shape[-3:], shape[0]) != shape:
        return image
    frames = image.reshape(-1, *image.shape[-3:])
    return np.stack(list(resized(frames, shape))).reshape(*image.shape[:-3], *shape, 3)
