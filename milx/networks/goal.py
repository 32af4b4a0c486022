"""Where the demonstration went, read off the image: a mixture density over the positions of a feature map.

With features f_p in R^C at the P positions p of the map, a learned filter w in R^C and a learned log sigma,

    p(g | image) = sum over p of softmax(w . f)_p N(g; v_p, sigma^2 I),        v_p = V^T (x_p, y_p, 1),

so every position votes for one goal v_p in R^G, the same for all images: an affine function of where the position lies,
with V in R^(3 x G), x_p and y_p in [-1, 1] across and down the image. The filter weighs the votes. The paper
(Section 6.3) predicts such a point with a linear layer and the squared error, whose best blind guess is the mean of all
candidates, which no candidate looks like. The best blind mixture finds the candidates; and the gradient of its
likelihood in the filter is the feature where the demonstration went minus the mean feature of the candidates. So one
inner step turns the filter towards what was shown.

All this waits until the votes are about right: from zero, one seed found them within 1,000 updates, another not within
2,000. So they start from the camera's calibration where it is known (`calibrate`), and are learned from there on.
"""

from typing import ClassVar, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from milx.networks.layers import Dense, positions
from milx.types import Params


class Goal(NamedTuple):
    """A mixture of isotropic Gaussians (Bishop 1994) over goals in R^G, in whitened units.

    Attributes:
        log_weight: [B, P] logarithms of the weights of the P positions.
        vote: [P, G] or [B, P, G] their means.
        log_std: scalar, logarithm of their common standard deviation.
    """

    log_weight: jax.Array
    vote: jax.Array
    log_std: jax.Array

    @property
    def mean(self) -> jax.Array:
        """[B, G] the expected goal."""
        return (jnp.exp(self.log_weight)[:, None] @ self.vote)[:, 0]

    def negative_log_likelihood(self, goal: jax.Array) -> jax.Array:
        """Computes [B] negative log-likelihoods of goals [B, G]."""
        size = self.vote.shape[-1]
        square = jnp.square(goal[:, None] - self.vote).sum(axis=-1)
        log_density = -0.5 * (square * jnp.exp(-2 * self.log_std) + size * jnp.log(2 * jnp.pi)) - size * self.log_std
        return -jax.nn.logsumexp(self.log_weight + log_density, axis=-1)


class GoalHead(nn.Module):
    """Maps features [B, H, W, C] to a `Goal`.

    Attributes:
        size: G.
    """

    size: int

    @nn.compact
    def __call__(self, features: jax.Array, query: jax.Array | None = None) -> Goal:
        """Predicts as the class says; `query` [B, C] is added to the filter."""
        batch, height, width, channels = features.shape
        kernel = self.param("kernel", nn.initializers.normal(channels**-0.5), (channels,))
        features = features.reshape(batch, height * width, channels)
        heat = features @ kernel
        if query is not None:
            heat += jnp.einsum("bpc,bc->bp", features, query)
        # The image reaches from -1 to 1: half a cell beyond the centers of the outermost.
        center = positions(height, width) * (1 - 1 / jnp.array([width, height]))
        place = jnp.append(center, jnp.ones((height * width, 1)), axis=-1)
        vote = place @ self.param("vote", nn.initializers.zeros, (3, self.size))
        return Goal(jax.nn.log_softmax(heat), vote, self.param("log_std", nn.initializers.zeros, ()))


class StateGoalHead(nn.Module):
    """Maps states [B, S] to a `Goal` where the policy sees no pixels: a few votes, each affine in the state.

    The inner step turns the votes' weights, which are the same for all states, towards what was shown. There are more
    votes than things to vote for: with as many (3), one of them stayed without a thing and the rest without a task.

    Attributes:
        size: G.
    """

    size: int
    candidates: ClassVar[int] = 8

    @nn.compact
    def __call__(self, state: jax.Array, query: jax.Array | None = None) -> Goal:
        """Predicts as the class says; `query` [B, candidates] is added to the logarithms of the weights."""
        heat = jnp.broadcast_to(
            self.param("heat", nn.initializers.zeros, (self.candidates,)), (len(state), self.candidates)
        )
        if query is not None:
            heat += query
        vote = nn.DenseGeneral((self.candidates, self.size), param_dtype=state.dtype, name="vote")(state)
        return Goal(jax.nn.log_softmax(heat), vote, self.param("log_std", nn.initializers.zeros, ()))


class HindsightHead(nn.Module):
    """Maps features of videos, [K, T, H, W, C], to where the robot went in each, a `Goal`.

    It compares the first image with the last: what was moved is there in one and not in the other.

    Attributes:
        size: G.
    """

    size: int
    hidden: ClassVar[int] = 32

    @nn.compact
    def __call__(self, features: jax.Array) -> Goal:
        """Predicts as the class says."""
        both = jnp.concatenate([features[:, 0], features[:, -1]], axis=-1)
        return GoalHead(self.size, name="goal_head")(Dense(self.hidden, hidden=True)(both))


def calibrate(params: Params, image_to_goal: jax.Array) -> Params:
    """Initializes a `GoalHead` with votes from the camera's calibration, and returns its parameters.

    Args:
        params: the head's parameters.
        image_to_goal: [3, G], takes (x, y, 1) with x and y in [-1, 1] across and down the image to a whitened goal.
    """
    return {**params, "vote": image_to_goal}


def sharpen(params: Params, power: float) -> Params:
    """Raises the weights of a `GoalHead`'s or a `StateGoalHead`'s votes to a power, and returns its parameters.

    The weights are a softmax of what is linear in "kernel" or "heat", so those are multiplied.
    """
    return {name: power * x if name in ("kernel", "heat") else x for name, x in params.items()}
