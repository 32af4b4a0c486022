"""Lighting: what color a surface shows under MuJoCo's lights.

The model is that of MuJoCo's OpenGL renderer: emission, then for every light an ambient term, a diffuse term n.l and a
Blinn-Phong specular term (n.h)^(128 shininess) with the half vector h between light and viewer, weakened with distance
and by the cone of a spot light. Here it is evaluated for every pixel, there for every vertex. All vectors are in the
camera frame. `L` denotes the lights and `P` the pixels.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from milx.render.raycast import Vector, dot

# Squared lengths and bases of powers are kept above this, so that neither they nor their gradients are ever NaN.
_SMALL = 1e-12
_WITHOUT_LIGHTS = 0.3
"""The ambient light in MuJoCo where no light is on."""


class Material(NamedTuple):
    """What a surface is made of, for every pixel."""

    rgb: Vector  # three [P] arrays
    emission: jax.Array  # [P] fraction of `rgb` that shines by itself
    specular: jax.Array  # [P]
    shininess: jax.Array  # [P] in [0, 1]


class Lights(NamedTuple):
    """Lights of all types in one form, as OpenGL has them."""

    ambient: jax.Array  # [L, 3]
    diffuse: jax.Array  # [L, 3]
    specular: jax.Array  # [L, 3]
    direction: jax.Array  # [L, 3] the way the light shines
    position: jax.Array  # [L, 4] homogeneous: (x, y, z, 1) m, or against the direction and 0 for a directional light
    attenuation: jax.Array  # [L, 3] coefficients of 1, distance and distance squared
    cutoff: jax.Array  # [L] least cosine to the direction that is lit: below -1 for any but spot lights
    exponent: jax.Array  # [L] of that cosine: 0 for any but spot lights


def _normalize(v: Vector) -> tuple[Vector, jax.Array]:
    """Divides a vector by its length, and returns both."""
    squared = jnp.maximum(dot(v, v), _SMALL)
    inverse = jax.lax.rsqrt(squared)
    return tuple(x * inverse for x in v), squared * inverse


def _power(base: jax.Array, exponent: jax.Array) -> jax.Array:
    """Computes `base ** exponent` for a base in [0, 1], cut off just above zero."""
    return jnp.exp(exponent * jnp.log(jnp.maximum(base, _SMALL)))


def emitted(material: Material) -> Vector:
    """Computes the color without any light: three [P] arrays."""
    return tuple(material.emission * channel for channel in material.rgb)


def headlight(model: mujoco.MjModel) -> np.ndarray:
    """Returns the ambient, diffuse and specular color of the headlight, [3, 3]; some is ambient if no light is on."""
    head = model.vis.headlight
    colors = head.active * np.stack([head.ambient, head.diffuse, head.specular])
    if not head.active and not model.light_active.any():
        colors[0] = _WITHOUT_LIGHTS
    return colors


def reflected(
    lights: Lights,
    material: Material,
    point: Vector,
    normal: Vector,
    blocked: Callable[[Vector, jax.Array], jax.Array] | None = None,
) -> Vector:
    """Sums the colors that the lights add.

    The lights are scanned, which also makes XLA compute each of the other arguments once: fused into the three channels
    of every light they would be computed again for each.

    Args:
        lights: the lights, in the camera frame.
        material: of the surface.
        point: three [P] arrays, m, where the surface is seen.
        normal: three [P] arrays of unit length.
        blocked: tells from the vector towards a light and the light's homogeneous coordinate (1, or 0 for a directional
            light) which points are in shadow, [P] bool. None for no shadows. The ambient term knows no shadow.

    Returns:
        Three [P] arrays, not clipped.
    """
    dark = tuple(jnp.zeros_like(channel) for channel in material.rgb)

    def add(color: Vector, light: Lights) -> tuple[Vector, None]:
        more = reflect(light, material, point, normal, blocked)
        return tuple(before + after for before, after in zip(color, more, strict=True)), None

    return jax.lax.scan(add, dark, lights)[0]


def reflect(
    light: Lights,
    material: Material,
    point: Vector,
    normal: Vector,
    blocked: Callable[[Vector, jax.Array], jax.Array] | None = None,
) -> Vector:
    """Computes the color that one light adds; `light` has no leading axis. For the rest see `reflected`."""
    w = light.position[3]
    path = tuple(light.position[i] - w * point[i] for i in range(3))
    to_light, distance = _normalize(path)
    to_eye, _ = _normalize(tuple(-x for x in point))
    half, _ = _normalize(tuple(a + b for a, b in zip(to_light, to_eye, strict=True)))

    facing = dot(normal, to_light)
    diffuse = jnp.maximum(facing, 0.0)
    shine = jnp.where(facing > 0, material.specular * _power(dot(normal, half), 128 * material.shininess), 0.0)
    if blocked is not None:
        lit = 1.0 - blocked(path, w)
        diffuse, shine = lit * diffuse, lit * shine

    constant, linear, quadratic = light.attenuation
    strength = 1 / jnp.maximum(constant + distance * (linear + distance * quadratic), _SMALL)
    cosine = -dot(tuple(light.direction), to_light)
    strength = strength * jnp.where(cosine >= light.cutoff, _power(cosine, light.exponent), 0.0)
    return tuple(
        strength * (material.rgb[i] * (light.ambient[i] + light.diffuse[i] * diffuse) + light.specular[i] * shine)
        for i in range(3)
    )
