"""What methods share that imitate actions: the loss, and a goal head's start from the camera's calibration."""

import jax
import jax.numpy as jnp

from milx.config import MILConfig
from milx.networks.goal import calibrate
from milx.networks.policy import PolicyOutput
from milx.types import Demo, Params
from milx.whitening import Whitening


def behavioural_cloning(
    config: MILConfig,
    output: PolicyOutput,
    action: jax.Array,
    demo: Demo,
    whitening: Whitening,
    goal_indices: tuple[int, ...],
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The mean squared error of the actions (eq. 2), plus the goal head's error where there is one.

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
    shown = demo.action.reshape(-1, demo.action.shape[-1])
    error = config.loss_scale * (action - whitening.action(shown))
    loss = action_loss = jnp.mean(jnp.square(error))
    metrics = {"action_loss": action_loss}
    if output.goal is not None and demo.goal is not None:
        indices = jnp.array(goal_indices)
        goal = (demo.goal - whitening.state_mean[indices]) / whitening.state_scale[indices]
        goal = goal.reshape(-1, len(goal_indices))
        metrics["goal_loss"] = output.goal.negative_log_likelihood(goal).mean()
        loss += config.goal_weight * metrics["goal_loss"]
    return loss, metrics


def calibrate_goal_head(
    policy: Params,
    image_to_goal: tuple[tuple[float, ...], ...] | None,
    goal_indices: tuple[int, ...],
    whitening: Whitening,
) -> Params:
    """A policy's parameters with its goal head started from the calibration (`Spec.image_to_goal`), if there is one."""
    if image_to_goal is None:
        return policy
    indices = jnp.array(goal_indices)
    votes = jnp.array(image_to_goal).at[-1].add(-whitening.state_mean[indices]) / whitening.state_scale[indices]
    controller = policy["controller"]
    return {**policy, "controller": {**controller, "goal_head": calibrate(controller["goal_head"], votes)}}
