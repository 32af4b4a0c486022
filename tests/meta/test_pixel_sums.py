"""Sums over pixels by a kernel of a GPU, interpreted, against sums of arrays."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.meta import pixel_sums as home
from milx.meta.pixel_sums import pixel_sums, scale_and_shift

# Tasks, images, rows, columns and channels; a program reads 256 rows of 16 numbers at once.
SHAPES = {"several steps": (2, 3, 20, 21, 10), "one pixel": (3, 1, 1, 1, 7), "many channels": (1, 2, 3, 3, 200)}


def plainly(u, x, gate=None):
    keep = 1 if gate is None else scale_and_shift(x, *gate) > 0
    return tuple((keep * each).sum(axis=(1, 2)) for each in (u, u * x))


def derivatives(by, inputs, directions, gate):
    """Returns value, gradient, forward over reverse, and reverse over reverse, of a function of the sums of tasks."""

    def cubed(inputs):
        sums = jax.vmap(by)(*inputs, gate)
        return sum(jnp.sum(each**3) for each in sums)

    def along(inputs):
        return sum(map(jnp.vdot, jax.grad(cubed)(inputs), directions))

    return jax.vmap(by)(*inputs, gate), jax.jvp(jax.grad(cubed), (inputs,), (directions,)), jax.grad(along)(inputs)


@pytest.mark.parametrize("gated", [False, True])
@pytest.mark.parametrize("shape", SHAPES)
def test_sums_and_their_derivatives(rng, shape, gated):
    tasks, images, *_, channels = SHAPES[shape]
    inputs, directions = (tuple(jnp.asarray(rng.standard_normal(SHAPES[shape])) for _ in range(2)) for _ in range(2))
    gate = tuple(jnp.asarray(rng.standard_normal(each)) for each in ((tasks, images), (tasks, images, channels)))
    found, expected = (
        derivatives(by, inputs, directions, gate if gated else None)
        for by in (functools.partial(pixel_sums, interpret=True), plainly)
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-8), found, expected)


def test_derivatives_of_the_sums_of_squares(rng):
    inputs, directions = ((jnp.asarray(rng.standard_normal((2, 3, 4, 5, 6))),) for _ in range(2))
    found, expected = (
        derivatives(lambda x, _, by=by: by(x, x), inputs, directions, None)
        for by in (functools.partial(pixel_sums, interpret=True), plainly)
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-8), found, expected)


def test_images_that_all_tasks_share(rng):
    u, x = (jnp.asarray(rng.standard_normal(shape)) for shape in ((2, 3, 4, 5, 6), (3, 4, 5, 6)))
    found = jax.vmap(functools.partial(pixel_sums, interpret=True), in_axes=(0, None))(u, x)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), found, jax.vmap(plainly, (0, None))(u, x))


def test_programs_share_many_steps(rng, monkeypatch):
    monkeypatch.setattr(home, "PROGRAMS", 8)
    monkeypatch.setattr(home, "_AT_ONCE", 64)
    u, x = (jnp.asarray(rng.standard_normal((3, 5, 23, 3))) for _ in range(2))  # a shape of its own: JAX keeps traces
    found = pixel_sums(u, x, interpret=True)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12), found, plainly(u, x))


@pytest.mark.parametrize("gated", [False, True])
def test_other_devices_sum_by_xla(rng, gated):
    u, x, scale, shift = (jnp.asarray(rng.standard_normal(s)) for s in ((2, 3, 4, 5), (2, 3, 4, 5), (2,), (2, 5)))
    gate = (scale, shift) if gated else None
    found = pixel_sums(u, x, gate)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10), found, plainly(u, x, gate))


@pytest.mark.parametrize("interpret", [False, True])
def test_bfloat16_is_summed_in_float32(rng, interpret):
    u, x = (jnp.asarray(rng.random((2, 63, 61, 3)), jnp.bfloat16) for _ in range(2))
    for found, expected in zip(pixel_sums(u, x, interpret=interpret), plainly(*map(np.float64, (u, x))), strict=True):
        assert found.dtype == jnp.float32
        np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("by_u", [False, True])
def test_derivatives_in_one_image_alone(rng, by_u):
    """The tangent of the other is zero."""
    u, x, direction = (jnp.asarray(rng.standard_normal((2, 3, 4, 5))) for _ in range(3))
    gate = jnp.asarray(rng.standard_normal(2)), jnp.asarray(rng.standard_normal((2, 5)))
    found, expected = (
        jax.jvp(lambda a, by=by: by(*((a, x) if by_u else (u, a)), gate), (u if by_u else x,), (direction,))
        for by in (functools.partial(pixel_sums, interpret=True), plainly)
    )
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10), found, expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"u": np.zeros((2, 4, 4, 5))}, r"u: got float64\[2, 4, 4, 5\], expected float64\[2, 2, 2, 5\]"),
        ({"u": np.zeros((2, 2, 2, 5), np.float32)}, "u: got float32"),
        ({"gate": (np.zeros(2), np.zeros(5))}, r"gate: got shapes \(2,\) and \(5,\), expected \(2,\) and \(2, 5\)"),
    ],
)
def test_other_shapes_and_types_are_refused(change, message):
    inputs = {"u": np.zeros((2, 2, 2, 5)), "x": np.zeros((2, 2, 2, 5)), **change}
    with pytest.raises(ValueError, match=message):
        pixel_sums(**inputs, interpret=True)


def test_more_numbers_than_32_bits_count_are_refused():
    x = jax.ShapeDtypeStruct((2**15, 256, 256, 1), jnp.bfloat16)
    with pytest.raises(ValueError, match="pixel_sums: got an array of 2147483648 numbers, expected at most"):
        jax.eval_shape(pixel_sums, x, x)


def test_more_numbers_than_32_bits_count_are_summed_task_by_task(rng, monkeypatch):
    monkeypatch.setattr(home, "MOST_NUMBERS", 100)
    u, x = (jnp.asarray(rng.standard_normal((3, 2, 4, 5, 2))) for _ in range(2))
    of_tasks = jax.vmap(functools.partial(pixel_sums, interpret=True))
    assert "scan" in str(jax.make_jaxpr(of_tasks)(u, x))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-10), of_tasks(u, x), jax.vmap(plainly)(u, x))
