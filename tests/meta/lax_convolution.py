"""What convolutions are compared with: `jax.lax`, and all their derivatives."""

import functools

import jax
import jax.numpy as jnp
import numpy as np


def reference_conv2d(x, kernel, stride):
    return jax.lax.conv_general_dilated(
        x, kernel, (stride, stride), padding="SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


@functools.partial(jax.jit, static_argnums=(0, 3))
def all_derivatives(conv, inputs, directions, stride):
    """Computes derivatives of a cubic function: forward, reverse, forward over reverse, and reverse over reverse."""

    def cubed(inputs):
        return jnp.sum(conv(*inputs, stride) ** 3)

    forward = jax.jvp(lambda inputs: conv(*inputs, stride), (inputs,), (directions,))
    over_reverse = jax.jvp(jax.grad(cubed), (inputs,), (directions,))
    along = lambda inputs: sum(map(jnp.vdot, jax.grad(cubed)(inputs), directions))  # noqa: E731
    return forward, over_reverse, jax.grad(along)(inputs)


def assert_agree(found, expected, tolerance):
    """Asserts that arrays differ by at most the tolerance times the largest number of each."""
    for ours, theirs in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=tolerance * np.abs(theirs).max())
