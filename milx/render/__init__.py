"""Rendering: MJX states to images, by ray casting in pure JAX."""

from milx.render.cameras import render
from milx.render.scene import Frame, Renderer, Scene, to_uint8

__all__ = ["Frame", "Renderer", "Scene", "render", "to_uint8"]
