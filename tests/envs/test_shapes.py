"""Shapes of things: closed forms of their outlines, and laws that all of them keep."""

import mujoco
import numpy as np
import planned
import pytest

from milx.envs.place import containers
from milx.envs.place.env import Place
from milx.envs.push.env import Push
from milx.envs.shapes import BY_SPLIT, SHAPES
from milx.envs.shapes.primitives import (
    NUM_CAPSULES,
    Box,
    Capsule,
    Cylinder,
    Ellipsoid,
    distance_to_outline,
    shape,
    to_geoms,
)


def outline(found):
    """Reads ends [N, 2, 2] and radii [N] of the capsules back from positions, quaternions and sizes."""
    ends, radius = [], []
    for pos, quat, size in zip(found.pos[:NUM_CAPSULES], found.quat, found.size, strict=False):
        if pos[2] > 0:  # not used otherwise
            axis = np.zeros(3)
            mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, size[1]]), quat)
            assert abs(axis[2]) < 1e-12, "capsules lie on the table"
            ends.append([(pos - axis)[:2], (pos + axis)[:2]])
            radius.append(size[0])
    return np.array(ends), np.array(radius)


def test_ball_is_a_disc_of_unit_radius_around_the_origin():
    found = to_geoms(shape(Capsule(3, -2, 3, -2, 0.4)))
    np.testing.assert_allclose(found.pos[0], [0, 0, 1], atol=0.02)
    assert found.size[0, 0] == pytest.approx(1, rel=0.01)
    assert found.squared_gyration == pytest.approx(1 / 2, rel=0.02)


def test_stick_has_the_area_and_gyration_of_a_rectangle_with_two_half_discs():
    length, radius = 2.0, 0.3
    found = to_geoms(shape(Capsule(0, 0, length * 0.6, length * 0.8, radius)))
    disc, rectangle = np.pi * radius**2, 2 * radius * length
    unit = np.sqrt((length / 2 + radius) * np.sqrt((disc + rectangle) / np.pi))
    # Half discs: their centers of mass lie 4 r / 3 pi beyond the ends.
    shift = 4 * radius / (3 * np.pi)
    discs = disc * (radius**2 / 2 - shift**2 + (length / 2 + shift) ** 2)
    gyration = (discs + rectangle * (length**2 + 4 * radius**2) / 12) / (disc + rectangle)
    assert found.size[0, 0] == pytest.approx(radius / unit, rel=0.01)
    assert found.squared_gyration == pytest.approx(gyration / unit**2, rel=0.01)


@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_is_centered_and_what_is_only_seen_stands_on_its_outline(name):
    found = to_geoms(SHAPES[name])
    ends, radius = outline(found)
    points = np.random.default_rng(0).uniform(-3, 3, (40_000, 2))
    inside = points[distance_to_outline(points, ends, radius) <= 0]
    deviation = inside.std(axis=0) / len(inside) ** 0.5
    assert (np.abs(inside.mean(axis=0)) < 4 * deviation + 0.01).all()

    for primitive in (p for kind in ("ellipsoids", "boxes", "cylinders") for p in getattr(SHAPES[name], kind)):
        low = primitive.z - (primitive.half if isinstance(primitive, Cylinder) else primitive.c)
        assert low > -1e-9, primitive
        capsules = SHAPES[name].capsules
        at = np.array([[[s.x0, s.y0], [s.x1, s.y1]] for s in capsules], float)
        assert distance_to_outline(rim(primitive), at, np.array([s.radius for s in capsules])).max() < 0.16, primitive


def rim(primitive):
    """Samples [N, 2] points of a detail's edge, seen from above."""
    if isinstance(primitive, Box):
        corners = np.array([[i * primitive.a, j * primitive.b] for i in (-1, 1) for j in (-1, 1)])
        turn = np.array(
            [[np.cos(primitive.turn), -np.sin(primitive.turn)], [np.sin(primitive.turn), np.cos(primitive.turn)]]
        )
        return corners @ turn.T + [primitive.x, primitive.y]
    a, b = (primitive.a, primitive.b) if isinstance(primitive, Ellipsoid) else (primitive.radius, primitive.radius)
    angle = np.linspace(0, 2 * np.pi, 60)
    return np.stack([primitive.x + a * np.cos(angle), primitive.y + b * np.sin(angle)], axis=-1)


def test_every_shape_is_in_one_split():
    assert [len(BY_SPLIT[split]) for split in ("train", "validation", "test")] == [105, 10, 11]
    assert sorted(name for names in BY_SPLIT.values() for name in names) == sorted(SHAPES)


def test_a_shape_that_does_not_fit_the_geoms_is_refused():
    with pytest.raises(ValueError, match="got 5 of Capsule, expected at most 4"):
        shape(*[Capsule(0, 0, 1, 0, 0.1)] * 5)
    with pytest.raises(ValueError, match="got no Capsule"):
        shape(Ellipsoid(0, 0, 1, 1, 1, 1))


def test_the_catalogue_of_objects_is_what_the_versions_say():
    """Compares every object's geoms, by one number each, and which split it is in: tasks refer to them by number."""
    found = []
    for catalogue, build, by_split in (
        (SHAPES, to_geoms, BY_SPLIT),
        (containers.CONTAINERS, containers.to_geoms, containers.BY_SPLIT),
    ):
        splits = {name: number for number, names in enumerate(by_split.values()) for name in names}
        for name, entry in catalogue.items():
            flat = np.concatenate([np.ravel(np.asarray(x, float)) for x in build(entry)])
            found += [splits[name], flat @ np.cos(np.arange(flat.size))]
    planned.check("objects", [Push.version, Place.version], np.array(found), atol=1e-6)
