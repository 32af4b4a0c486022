"""Solid textures: where they lie, and that both renderers show them."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_raycast import random_scene

from milx.render import Renderer, textures
from milx.render.scene import to_uint8

NAMES = list(textures.FAMILIES)


def test_every_family_belongs_to_one_split():
    assert sorted(sum(textures.BY_SPLIT.values(), ())) == sorted(NAMES)


@pytest.mark.parametrize("split", textures.BY_SPLIT)
def test_frames_turn_evenly_and_scale_by_the_period(split):
    drawn = jax.vmap(lambda key: textures.draw(key, split))(jax.random.split(jax.random.key(0), 500))
    assert {NAMES[i] for i in np.asarray(drawn.family)} == set(textures.BY_SPLIT[split])
    linear = np.asarray(drawn.frame[..., :3], float)
    period = np.linalg.det(linear) ** (-1 / 3)
    assert textures.PERIOD[0] < period.min() < period.max() < textures.PERIOD[1]
    turn = linear * period[:, None, None]
    np.testing.assert_allclose(turn @ turn.swapaxes(1, 2), np.broadcast_to(np.eye(3), turn.shape), atol=1e-5)
    # Of a rotation that is drawn evenly every entry is 0 on average; 500 draws are off by less than 5 deviations.
    assert np.abs(turn.mean(axis=0)).max() < 5 / np.sqrt(3 * 500)


@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("plain", "noise", "marble", "rings")])
def test_regular_families_repeat(name):
    place = tuple(jnp.asarray(np.random.default_rng(0).uniform(-2, 2, (3, 2000)), jnp.float32))
    moved = tuple(x + 2 for x in place)
    # Where an edge is sharp, rounding of the place shows.
    off = np.abs(textures.FAMILIES[name](place) - textures.FAMILIES[name](moved))
    assert np.quantile(off, 0.99) < 1e-3


def test_waves_are_those_of_the_sine():
    """Of checks with these other coordinates a whole wave shows: 0.5 + 0.5 sin(2 pi x)."""
    x = np.linspace(-4, 4, 4001, dtype=np.float32)
    other = np.full_like(x, 0.25), np.full_like(x, np.arcsin(1 / 16) / (2 * np.pi))
    shown = textures.FAMILIES["checks"](tuple(jnp.asarray(p) for p in (x, *other)))
    # A series that ends with the ninth power is off by up to (pi / 2)^11 / 11! = 4e-6, and half of it shows.
    np.testing.assert_allclose(shown, 0.5 + 0.5 * np.sin(2 * np.pi * x.astype(float)), atol=6e-6)


@pytest.mark.parametrize("name", NAMES[1:])
def test_both_colors_show_on_a_thing(name):
    """Covers a ball as large as a small object, in the largest period."""
    rng = np.random.default_rng(0)
    place = rng.normal(size=(3, 4000))
    place *= 0.04 / textures.PERIOD[1] / np.linalg.norm(place, axis=0) * rng.uniform(size=4000) ** (1 / 3)
    weight = textures.FAMILIES[name](tuple(jnp.asarray(place + rng.uniform(size=(3, 1)))))
    assert weight.min() >= 0 and weight.max() <= 1
    assert 0.02 < (weight > 0.5).mean() < 0.98 or name == "plaid"
    assert weight.max() - weight.min() > 0.4


def textured(seed):
    """Makes a renderer, and a scene in which every geom has another texture that is fixed to its body."""
    model = mujoco.MjModel.from_xml_string(random_scene(seed))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    renderer = Renderer(model, "eye", 37, 50)
    scene = renderer.scene(data)
    keys = jax.random.split(jax.random.key(seed), model.ngeom)
    texture = jax.vmap(lambda key: textures.draw(key, "train"))(keys)
    texture = texture._replace(
        family=(1 + jnp.arange(model.ngeom)) % len(NAMES),
        frame=textures.in_world(texture.frame / 10, scene.geom_xpos, scene.geom_xmat),
    )
    return renderer, dataclasses.replace(scene, texture=texture)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_kernel_paints_the_textures_of_the_reference(seed):
    renderer, scene = textured(seed)
    plain = jax.jit(renderer.render)(dataclasses.replace(scene, texture=None))
    frame = jax.jit(renderer.render)(scene)
    painted = jax.jit(lambda scene: renderer.paint(scene, interpret=True))(scene)
    expected = np.asarray(to_uint8(frame.color)).astype(int)
    # Edges of textures and of geoms may turn over with rounding.
    assert (np.abs(np.asarray(painted).astype(int) - expected).max(axis=-1) > 2).mean() < 1e-2
    covered = np.asarray(frame.geom_id) >= 0
    assert (np.abs(frame.color - plain.color).max(axis=-1) > 0.02)[covered].mean() > 0.2


@pytest.mark.slow
def test_a_texture_moves_with_the_whole_scene():
    """Turns and shifts objects, camera and textures together: the image stays the same."""
    renderer, scene = textured(0)
    turn = jnp.asarray(Rotation.from_euler("xyz", [0.4, -0.7, 1.1]).as_matrix(), jnp.float32)
    shift = jnp.array([0.3, -0.2, 0.5])
    frame = scene.texture.frame
    moved = dataclasses.replace(
        scene,
        geom_xpos=scene.geom_xpos @ turn.T + shift,
        geom_xmat=turn @ scene.geom_xmat,
        cam_xpos=turn @ scene.cam_xpos + shift,
        cam_xmat=turn @ scene.cam_xmat,
        light_xpos=scene.light_xpos @ turn.T + shift,
        light_xdir=scene.light_xdir @ turn.T,
        texture=scene.texture._replace(frame=textures.in_world(frame, shift, turn)),
    )
    before, after = (np.asarray(renderer.render(s).color) for s in (scene, moved))
    assert (np.abs(before - after).max(axis=-1) > 0.01).mean() < 1e-2
