"""Sums over pixels by a kernel of a GPU, interpreted, against sums of an array."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.meta import pixel_sums

# Tasks, images, rows, columns and channels; the program adds 512 rows of 16 numbers at once.
SHAPES = {"several programs": (2, 3, 20, 21, 10), "one pixel": (3, 1, 1, 1, 7), "many channels": (1, 2, 3, 3, 200)}


def of_tasks(x):
    return jax.vmap(lambda x: pixel_sums.sum_over_pixels(x, interpret=True))(x)


def plainly(x):
    return x.reshape(len(x), -1, x.shape[-1]).sum(axis=1)


@pytest.mark.parametrize("shape", SHAPES)
def test_sums_and_their_derivatives(rng, shape):
    x, direction = (jnp.asarray(rng.standard_normal(SHAPES[shape])) for _ in range(2))

    def derivatives(sums):
        cubed = lambda x: jnp.sum(sums(x) ** 3)  # noqa: E731
        along = lambda x: jnp.vdot(jax.grad(cubed)(x), direction)  # noqa: E731
        return sums(x), jax.jvp(jax.grad(cubed), (x,), (direction,)), jax.grad(along)(x)

    for found, expected in zip(
        jax.tree.leaves(derivatives(of_tasks)), jax.tree.leaves(derivatives(plainly)), strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-9)


def test_programs_share_many_steps(rng, monkeypatch):
    monkeypatch.setattr(pixel_sums, "PROGRAMS", 2)
    monkeypatch.setattr(pixel_sums, "_AT_ONCE", 64)
    x = jnp.asarray(rng.standard_normal((2, 5, 23, 3)))  # a shape of its own, since JAX keeps what it has traced
    np.testing.assert_allclose(of_tasks(x[None])[0], plainly(x[None])[0], rtol=1e-12)


def test_other_devices_sum_by_xla(rng):
    x = jnp.asarray(rng.standard_normal((3, 4, 5)))
    np.testing.assert_allclose(pixel_sums.sum_over_pixels(x), x.sum(axis=(0, 1)), rtol=1e-12)


def test_more_numbers_of_a_task_than_32_bits_count_are_refused():
    x = jax.ShapeDtypeStruct((2**15, 256, 256, 1), jnp.bfloat16)
    with pytest.raises(ValueError, match="sum_over_pixels: got an array of 2147483648 numbers, expected at most"):
        jax.eval_shape(pixel_sums.sum_over_pixels, x)


def test_more_numbers_than_32_bits_count_are_summed_task_by_task(rng, monkeypatch):
    monkeypatch.setattr(pixel_sums, "MOST_NUMBERS", 100)
    x = jnp.asarray(rng.standard_normal((3, 2, 4, 5, 2)))
    program = str(jax.make_jaxpr(of_tasks)(x))
    assert "scan" in program
    np.testing.assert_allclose(of_tasks(x), plainly(x), rtol=1e-12)
