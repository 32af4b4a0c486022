"""Changes of demonstrations in training: what was shown once stands for other views, lights, and its mirror image."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from milx.types import Demo


def augmented(image: Any, key: jax.Array, shift: int, recolor: float, crop: int = 0) -> Any:
    """Changes the images of a demonstration, all of one camera alike.

    Args:
        image: [T, H, W, 3 N] uint8, N images side by side; of several cameras a dictionary by name, None for none.
        key: draws the changes, others for every camera.
        shift: the largest number of pixels by which images are moved down and to the right, or up and to the left; the
            pixels at the edge are repeated (Yarats, Kostrikov and Fergus 2021).
        recolor: every channel is multiplied by a factor between 1 - recolor and 1 + recolor.
        crop: images [T, H - 2 crop, W - 2 crop, 3 N] are left, cut out at a random place (Laskin et al. 2020): their
            middle is moved by at most shift + crop pixels.
    """
    leaves, structure = jax.tree.flatten(image)
    keys = jax.random.split(key, max(len(leaves), 1))
    changed = [_one_camera(x, key, shift, recolor, crop) for x, key in zip(leaves, keys, strict=False)]
    return jax.tree.unflatten(structure, changed)


def _one_camera(image: jax.Array, key: jax.Array, shift: int, recolor: float, crop: int) -> jax.Array:
    shift_key, color_key = jax.random.split(key)
    if shift or crop:
        steps, height, width, channels = image.shape
        padded = jnp.pad(image, ((0, 0), (shift, shift), (shift, shift), (0, 0)), mode="edge")
        y, x = jax.random.randint(shift_key, (2,), 0, 2 * (shift + crop) + 1)
        left = steps, height - 2 * crop, width - 2 * crop, channels
        image = jax.lax.dynamic_slice(padded, (0, y, x, 0), left)
    if recolor:
        factor = jax.random.uniform(color_key, (3,), minval=1 - recolor, maxval=1 + recolor)
        image = jnp.clip(jnp.round(image * jnp.tile(factor, image.shape[-1] // 3)), 0, 255).astype(jnp.uint8)
    return image


def mirrored(demo: Demo, mirror: tuple[tuple[int, ...], tuple[int, ...]], goal_indices: tuple[int, ...]) -> Demo:
    """Shows a demonstration in a mirror that swaps the left and the right of its images.

    Args:
        demo: one demonstration or several, [..., T, ...], with states, actions and goals (of no entries if there are no
            indices), and with images of one camera or none.
        mirror: the signs of the entries of state and action, as `Env.mirror`; actions may be chunks.
        goal_indices: the entries of the state that tell the goal.
    """
    state, action = map(np.asarray, mirror)
    return dataclasses.replace(
        demo,
        image=None if demo.image is None else demo.image[..., ::-1, :],
        state=demo.state * state,
        action=demo.action * np.tile(action, demo.action.shape[-1] // len(action)),
        goal=demo.goal * state[list(goal_indices)],
    )
