"""What methods share that imitate: what they are shown, the loss, a goal head's start from the camera's calibration."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp

from milx.config.schema import GIVEN, Config, MethodConfig, VisionConfig
from milx.methods.whitening import Whitening
from milx.networks.goal import Goal, calibrate
from milx.networks.policy_network import PolicyOutput
from milx.types import Demo, Params, Spec


def shown(demo: Demo, given: str, whitening: Whitening) -> Demo:
    """Replaces what is not `given` (`MethodConfig.given`) of demonstrations [K, T, ...] by its mean."""
    if given == GIVEN[0]:
        return demo
    shape = jax.tree.leaves(demo)[0].shape[:2]
    action = jnp.broadcast_to(whitening.action_mean, (*shape, *whitening.action_mean.shape))
    if given == GIVEN[1]:
        return dataclasses.replace(demo, action=action)
    state = jnp.broadcast_to(whitening.state_mean, (*shape, *whitening.state_mean.shape))
    return dataclasses.replace(demo, state=state, action=action, goal=None)


def flat(demo: Demo) -> Demo:
    """Joins all time steps of demonstrations [K, T, ...], one after the other."""
    return jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), demo)


def behavioral_cloning(
    config: MethodConfig,
    output: PolicyOutput,
    action: jax.Array,
    demo: Demo,
    whitening: Whitening,
    goal_indices: tuple[int, ...],
    class_indices: tuple[int, ...] = (),
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Computes the imitation loss of demonstrations (eq. 2), with those of a goal head and a target head.

        L = mean((m (a - a_hat))^2) + w (L_goal + L_target)

    The mean is over demonstrations, time steps and entries of the whitened action; m is `config.loss_scale` and w is
    `config.goal_weight`. L_goal is the goal head's mean negative log-likelihood, and L_target is the target head's mean
    squared error. For an entry of the action that is a class, a = -1 or 1, the loss is m^2 log(1 + exp(-2 a a_hat)) in
    the place of the square: the negative log-likelihood of a with the probability 1 / (1 + exp(-2 a_hat)) of 1.

    Args:
        config: scale and weight of the losses.
        output: what the network said of all time steps of `demo`, one after the other.
        action: [K T, A], the whitened actions a_hat of the head that the loss is about.
        demo: demonstrations [K, T, ...].
        whitening: of `demo`.
        goal_indices: entries of the state that the goal head predicts.
        class_indices: entries of the action that are classes.

    Returns:
        The sum, and its parts.
    """
    seen = flat(demo)
    white = whitening.action(seen.action)
    loss = jnp.square(config.loss_scale * (action - white))
    for i in class_indices:
        likelihood = jax.nn.softplus(-2 * jnp.sign(white[:, i]) * action[:, i])
        loss = loss.at[:, i].set(config.loss_scale**2 * likelihood)
    action_loss = jnp.mean(loss)
    of_heads = head_losses(output, demo, whitening, goal_indices)
    return action_loss + config.goal_weight * sum(of_heads.values()), {"action_loss": action_loss, **of_heads}


def head_losses(
    output: PolicyOutput, demo: Demo, whitening: Whitening, goal_indices: tuple[int, ...]
) -> dict[str, jax.Array]:
    """Computes the errors of the goal head and of the target head, if there is one and `demo` tells the goal."""
    losses = {}
    if demo.goal is not None and output.goal is not None:
        losses["goal_loss"] = goal_loss(output.goal, demo.goal, whitening, goal_indices)
    if demo.goal is not None and output.target is not None:
        losses["target_loss"] = target_loss(output.target, demo.goal, whitening, goal_indices)
    return losses


def goal_loss(predicted: Goal, goal: jax.Array, whitening: Whitening, goal_indices: tuple[int, ...]) -> jax.Array:
    """Computes the mean negative log-likelihood of goals [K, T, G], predicted for all time steps in a row."""
    return _mean_where_known(predicted.negative_log_likelihood, goal, whitening, goal_indices)


def target_loss(target: jax.Array, goal: jax.Array, whitening: Whitening, goal_indices: tuple[int, ...]) -> jax.Array:
    """Computes the mean squared error of a target head's [K T, G] for goals [K, T, G], whitened, over all entries."""

    def error(white: jax.Array) -> jax.Array:
        return jnp.square(target - white).mean(axis=-1)

    return _mean_where_known(error, goal, whitening, goal_indices)


def _mean_where_known(
    error: Callable[[jax.Array], jax.Array], goal: jax.Array, whitening: Whitening, goal_indices: tuple[int, ...]
) -> jax.Array:
    """Averages an error [K T] of whitened goals [K, T, G] over the known goals; a goal that is not known is NaN."""
    indices = jnp.array(goal_indices)
    white = ((goal - whitening.state_mean[indices]) / whitening.state_scale[indices]).reshape(-1, len(goal_indices))
    known = jnp.isfinite(white).all(axis=-1)
    errors = error(jnp.where(known[:, None], white, 0.0))
    return jnp.where(known, errors, 0.0).sum() / jnp.maximum(known.sum(), 1)


def calibration(config: Config, spec: Spec) -> tuple[tuple[float, ...], ...] | None:
    """Returns the camera's calibration (`Spec.image_to_goal`) if goal heads are to start from it."""
    network = config.network
    calibrated = isinstance(network, VisionConfig) and network.goal_head and network.calibrate
    return spec.image_to_goal if calibrated and spec.image_shape is not None else None


def calibrate_goal_head(
    policy: Params,
    image_to_goal: tuple[tuple[float, ...], ...] | None,
    goal_indices: tuple[int, ...],
    whitening: Whitening,
) -> Params:
    """Starts a policy's goal heads from the calibration (`Spec.image_to_goal`), if it is known."""
    if image_to_goal is None:
        return policy
    indices = jnp.array(goal_indices)
    votes = jnp.array(image_to_goal).at[-1].add(-whitening.state_mean[indices]) / whitening.state_scale[indices]
    heads: Params = {name: policy[name] for name in ("controller", "hindsight") if name in policy}
    heads = {name: {**part, "goal_head": calibrate(part["goal_head"], votes)} for name, part in heads.items()}
    return {**policy, **heads}
