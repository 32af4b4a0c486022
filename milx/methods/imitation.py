"""What methods share that imitate: what they are shown, the loss, a goal head's start from the camera's calibration."""

import dataclasses

import jax
import jax.numpy as jnp

from milx.config import GIVEN, MILConfig
from milx.networks.goal import Goal, calibrate
from milx.networks.policy import PolicyOutput
from milx.types import Demo, Params
from milx.whitening import Whitening


def shown(demo: Demo, given: str, whitening: Whitening) -> Demo:
    """Demonstrations [K, T, ...] without what is not `given` (`MILConfig.given`): their mean stands in its place."""
    if given == GIVEN[0]:
        return demo
    shape = (demo.state if demo.image is None else demo.image).shape[:2]
    action = jnp.broadcast_to(whitening.action_mean, (*shape, *whitening.action_mean.shape))
    if given == GIVEN[1]:
        return dataclasses.replace(demo, action=action)
    state = jnp.broadcast_to(whitening.state_mean, (*shape, *whitening.state_mean.shape))
    return dataclasses.replace(demo, state=state, action=action, goal=None)


def flat(demo: Demo) -> Demo:
    """All time steps of demonstrations [K, T, ...], one after the other."""
    return jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), demo)


def behavioural_cloning(
    config: MILConfig,
    output: PolicyOutput,
    action: jax.Array,
    demo: Demo,
    whitening: Whitening,
    goal_indices: tuple[int, ...],
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The mean squared error of the actions (eq. 2), plus the error of the goal head where there is one.

    Args:
        config: scale and weight of the losses.
        output: what the network said of all time steps of `demo`, one after the other.
        action: [K T, A], the head that is meant.
        demo: demonstrations [K, T, ...].
        whitening: of `demo`.
        goal_indices: entries of the state that the goal head predicts.

    Returns:
        The sum, and its parts.
    """
    seen = flat(demo)
    error = config.loss_scale * (action - whitening.action(seen.action))
    loss = action_loss = jnp.mean(jnp.square(error))
    metrics = {"action_loss": action_loss}
    if output.goal is not None and demo.goal is not None:
        metrics["goal_loss"] = goal_loss(output.goal, demo.goal, whitening, goal_indices)
        loss += config.goal_weight * metrics["goal_loss"]
    return loss, metrics


def goal_loss(predicted: Goal, goal: jax.Array, whitening: Whitening, goal_indices: tuple[int, ...]) -> jax.Array:
    """The mean negative log likelihood of goals [K, T, G], predicted for all time steps one after the other.

    Where a goal is not known (NaN) there is no error.
    """
    indices = jnp.array(goal_indices)
    white = ((goal - whitening.state_mean[indices]) / whitening.state_scale[indices]).reshape(-1, len(goal_indices))
    known = jnp.isfinite(white).all(axis=-1)
    error = predicted.negative_log_likelihood(jnp.where(known[:, None], white, 0.0))
    return jnp.where(known, error, 0.0).sum() / jnp.maximum(known.sum(), 1)


def calibrate_goal_head(
    policy: Params,
    image_to_goal: tuple[tuple[float, ...], ...] | None,
    goal_indices: tuple[int, ...],
    whitening: Whitening,
) -> Params:
    """A policy's parameters with its goal heads started from the calibration (`Spec.image_to_goal`) if known."""
    if image_to_goal is None:
        return policy
    indices = jnp.array(goal_indices)
    votes = jnp.array(image_to_goal).at[-1].add(-whitening.state_mean[indices]) / whitening.state_scale[indices]
    heads = {name: policy[name] for name in ("controller", "hindsight") if name in policy}
    heads = {name: {**part, "goal_head": calibrate(part["goal_head"], votes)} for name, part in heads.items()}
    return {**policy, **heads}
