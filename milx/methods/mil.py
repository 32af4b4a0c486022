"""Meta-imitation learning: MAML through a step of behavioral cloning (paper, Section 4).

For a task with demonstrations d (support) and d' (query) of the same goal in different scenes,

    theta' = theta - alpha clip(grad_theta L(theta, d))          the inner step (Section 3.2)
    minimize over theta the mean over tasks of L(theta', d')     the meta-objective (eq. 1, a sum there)

with the behavioral cloning loss of K demonstrations of T time steps and actions in R^A,

    L(theta, d) = 1 / (K T A) sum over k, t, i of (m (a_kti - pi_theta(o_kt)_i))^2,

which is eq. 2 but for the factor m^2 / (K T A). Where d shows no actions the inner step descends a learned loss instead
(Section 4.3), whose parameters are part of theta. `jax.grad` goes through the inner step, `vmap` over the tasks.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from milx import meta
from milx.config.schema import GIVEN, Config, MethodConfig, number
from milx.meta.objective import for_each_task
from milx.methods.base import Method
from milx.methods.imitation import (
    behavioral_cloning,
    calibrate_goal_head,
    calibration,
    flat,
    goal_loss,
    head_losses,
    shown,
)
from milx.methods.whitening import Whitening
from milx.networks.goal import Goal, sharpen
from milx.networks.learned_loss import KINDS
from milx.networks.policy_network import BIAS_TRANSFORMATION, PolicyConfig, PolicyNetwork, PolicyOutput, make_policy
from milx.types import Demo, Memory, Observation, Params, Spec, TaskBatch, TaskParams

VARIANTS = ("maml", "anil", "boil", "cavia", "multi_step")
"""Relatives of MAML (Finn et al. 2017): the inner step changes the last layer only (ANIL, Raghu et al. 2020), all but
the last (BOIL, Oh et al. 2021) or the bias transformation only (CAVIA, Zintgraf et al. 2019); or the loss after every
inner step counts (MAML++, Antoniou et al. 2019)."""


@dataclasses.dataclass
class MILConfig(MethodConfig):
    """Meta-imitation learning (paper, Section 4).

    Attributes:
        inner_steps: gradient steps of an adaptation.
        inner_lr: their learning rate alpha.
        learn_inner_lr: meta-learn a factor on alpha for every tensor.
        inner_clip: bound on each entry of the inner gradient.
        first_order: do not differentiate through the inner gradient.
        variant: one of VARIANTS: what the inner step changes, or which of its results the meta-objective sees.
        imitation_steps: number of meta-updates at the start that imitate all demonstrations without an inner step.
        sharpness: the power to which an adapted policy raises the weights of its goal head's votes. Above 1, votes that
            are divided between two objects fall to one of them. Meta-training always uses 1.
    """

    inner_steps: int = number(1, 0, 1000)
    inner_lr: float = number(1e-3, 0)
    learn_inner_lr: bool = False
    inner_clip: float = number(20.0, 0)
    first_order: bool = False
    variant: str = "maml"
    imitation_steps: int = number(0, 0)
    sharpness: float = number(1.0, 0)


@dataclasses.dataclass(frozen=True, eq=False)
class MIL(Method):
    """Meta-imitation learning with one or two heads.

    `params` holds the network's parameters ("policy"), the whitening, which no gradient reaches, and, if the inner
    learning rate is learned, the logarithm of its factor for every tensor ("inner_log_lr"). `task_params` holds the
    adapted network's parameters and the whitening.

    Attributes:
        config: inner steps and losses.
        network: the policy network.
        goal_indices: entries of the state that the goal head predicts.
        image_to_goal: [3, G] from (x, y, 1), x and y in [-1, 1] across and down the image, to those entries, to start
            the goal heads from; None without one, or if they must learn that by themselves.
        class_indices: entries of the action that take two values.
    """

    config: MILConfig
    network: PolicyNetwork
    goal_indices: tuple[int, ...] = ()
    image_to_goal: tuple[tuple[float, ...], ...] | None = None
    class_indices: tuple[int, ...] = ()

    @property
    def imitation_steps(self) -> int:
        """See `MILConfig`."""
        return self.config.imitation_steps

    def init(self, key: jax.Array, whitening: Whitening) -> Params:
        """Draws the network's parameters."""
        theta = self.network.init(key)
        theta = calibrate_goal_head(theta, self.image_to_goal, self.goal_indices, whitening)
        params = {"policy": theta, "whitening": whitening}
        if self.config.learn_inner_lr:
            params["inner_log_lr"] = jax.tree.map(lambda _: jnp.zeros(()), params["policy"])
        return params

    def adapt(self, params: Params, demo: Demo) -> TaskParams:
        """Takes the inner gradient steps on demonstrations [K, T, ...]: their gradients are averaged.

        Then the weights of the votes of a goal head are raised to the power of `config.sharpness`.
        """
        theta = self._steps(params, demo)
        if self.config.sharpness != 1 and "goal_head" in (controller := theta["controller"]):
            head = sharpen(controller["goal_head"], self.config.sharpness)
            theta = {**theta, "controller": {**controller, "goal_head": head}}
        return {"policy": theta, "whitening": params["whitening"]}

    def _steps(self, params: Params, demo: Demo, path: bool = False) -> Params:
        """Takes the inner steps: the network's parameters after them, or after each with a leading axis."""
        theta, demo = params["policy"], shown(demo, self.config.given, params["whitening"])
        demo = self._with_goal_in_hindsight(params, demo)
        rate: Any = self.config.inner_lr
        if self.config.learn_inner_lr:
            rate = jax.tree.map(lambda s: self.config.inner_lr * jnp.exp(s), params["inner_log_lr"])
        return meta.adapt(
            self._inner_loss,
            theta,
            params["whitening"],
            demo,
            steps=self.config.inner_steps,
            rate=rate,
            clip=self.config.inner_clip,
            mask=self._adapted(theta),
            order="first_order" if self.config.first_order else "forward_over_reverse",
            path=path,
        )

    def _adapted(self, theta: Params) -> Params:
        """Tells which tensors the inner step changes, a bool for each."""

        def adapts(path: tuple, _: jax.Array) -> bool:
            names = {entry.key for entry in path}
            is_last = "controller" in names and not names.isdisjoint(self.network.output_layers)
            return {"anil": is_last, "boil": not is_last, "cavia": BIAS_TRANSFORMATION in names}.get(
                self.config.variant, True
            )

        return jax.tree_util.tree_map_with_path(adapts, theta)

    def unadapted(self, params: Params) -> TaskParams:
        """Returns the parameters from which every task is learned."""
        return {"policy": params["policy"], "whitening": params["whitening"]}

    def loss(
        self, params: Params, batch: TaskBatch, progress: jax.Array | float = 1.0
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Computes the meta-objective, averaged over the tasks, and its parts, [N].

        With the variant "multi_step" it is sum over i = 1..n of w_i L(theta_i, d'), theta_i being the parameters after
        i of the n inner steps, with the weights of `meta.multi_step_loss` (Antoniou et al. 2019, Section 4).
        A hindsight head learns from the queries beside it, unadapted, as the inner step uses it.
        """

        def task_loss(params: Params, support: Demo, query: Demo) -> tuple[jax.Array, dict[str, jax.Array]]:
            if self.config.variant != "multi_step":
                return self._query_loss(params, self._steps(params, support), query)
            thetas = self._steps(params, support, path=True)
            found = [
                self._query_loss(params, jax.tree.map(lambda x, i=i: x[i], thetas), query)
                for i in range(self.config.inner_steps)
            ]
            loss = meta.multi_step_loss(jnp.stack([loss for loss, _ in found]), progress)
            return loss, found[-1][1]

        loss, metrics = jax.vmap(task_loss)(for_each_task(params, len(batch.query.action)), batch.support, batch.query)
        return loss.mean(), {"loss": loss, **metrics}

    def imitation(self, params: Params, batch: TaskBatch) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Computes L(theta, d) + L(theta, d') without an inner step; d through the inner loss's head if it has actions.

        The policy learns what all tasks share, so that the first inner gradients point at what is special about one.
        """

        def task_loss(support: Demo, query: Demo) -> tuple[jax.Array, dict[str, jax.Array]]:
            loss, metrics = self._query_loss(params, params["policy"], query)
            if self.network.learned_loss is None:
                loss += self._inner_loss(params["policy"], params["whitening"], support)
            return loss, metrics

        loss, metrics = jax.vmap(task_loss)(batch.support, batch.query)
        return loss.mean(), {"loss": loss, **metrics}

    def _query_loss(self, params: Params, theta: Params, query: Demo) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Computes the loss of parameters theta of the network on a task's queries, and its parts."""
        loss, metrics = self.imitation_loss(theta, params["whitening"], query)
        if self.network.hindsight is not None and query.goal is not None:
            whitening = jax.lax.stop_gradient(params["whitening"])
            told = self._in_hindsight(params["policy"], whitening, query)
            metrics["hindsight_loss"] = goal_loss(told, query.goal[:, :1], whitening, self.goal_indices)
            loss += self.config.goal_weight * metrics["hindsight_loss"]
        return loss, metrics

    def act(self, task_params: TaskParams, observation: Observation, memory: Memory) -> tuple[jax.Array, Memory]:
        """Chooses the adapted network's action. The memory is what a target head saw in the first observation."""
        whitening, batch = task_params["whitening"], jax.tree.map(lambda x: x[None], observation)
        target = memory[None] if self.network.has_target else None
        output = self.network.apply(task_params["policy"], batch.image, whitening.state(batch.state), 1, target)
        action = whitening.unwhiten_action(output.action[0], self.class_indices)
        return action, memory if output.target is None else output.target[0]

    def initial_memory(self, key: jax.Array) -> Memory:
        """Returns nothing; for a target head the target [G], not known yet (NaN)."""
        return jnp.full(len(self.goal_indices), jnp.nan) if self.network.has_target else ()

    def _inner_loss(self, theta: Params, whitening: Whitening, demo: Demo) -> jax.Array:
        if self.network.learned_loss is None:
            return self.imitation_loss(theta, whitening, demo, inner=True)[0]
        output = self._apply(theta, whitening, demo)
        loss = self.network.learned_loss(theta, output.features.reshape(*demo.state.shape[:2], -1)).mean()
        return loss + self.config.goal_weight * sum(head_losses(output, demo, whitening, self.goal_indices).values())

    def _with_goal_in_hindsight(self, params: Params, demo: Demo) -> Demo:
        """Gives a video without states a goal for its first image: the hindsight head's.

        In training it is the first image that was drawn (`train.support_frames`), which may show the hand on its way.
        """
        if self.network.hindsight is None:
            return demo
        whitening, indices = params["whitening"], jnp.array(self.goal_indices, int)
        goal = self._in_hindsight(params["policy"], whitening, demo).mean
        goal = whitening.state_mean[indices] + whitening.state_scale[indices] * goal
        unknown = jnp.full((*demo.state.shape[:2], len(indices)), jnp.nan)
        return dataclasses.replace(demo, goal=unknown.at[:, 0].set(goal))

    def _in_hindsight(self, theta: Params, whitening: Whitening, demo: Demo) -> Goal:
        """Predicts where the robot went in each of the demonstrations [K, T, ...], by their first and last images."""
        ends = jax.tree.map(lambda x: x[:, jnp.array([0, -1])], demo)
        maps = self._apply(theta, whitening, ends).feature_map
        assert self.network.hindsight is not None and maps is not None
        return self.network.hindsight(theta, maps.reshape(len(demo.state), 2, *maps.shape[1:]))

    def _apply(self, theta: Params, whitening: Whitening, demo: Demo) -> PolicyOutput:
        """Applies the network to all time steps of demonstrations [K, T, ...], one after the other."""
        seen = flat(demo)
        return self.network.apply(theta, seen.image, whitening.state(seen.state), demo.state.shape[1])

    def imitation_loss(
        self, theta: Params, whitening: Whitening, demo: Demo, inner: bool = False
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Computes `imitation.behavioral_cloning` of the network on demonstrations [K, T, ...].

        `inner` selects the head of the inner loss. Returns the sum and its parts.
        """
        whitening = jax.lax.stop_gradient(whitening)
        output = self._apply(theta, whitening, demo)
        action = output.inner_action if inner else output.action
        indices = self.goal_indices, self.class_indices
        return behavioral_cloning(self.config, output, action, demo, whitening, *indices)


def make_mil(config: Config, spec: Spec) -> MIL:
    """Builds MIL.

    Raises:
        ValueError: for settings that do not fit together, or do not fit what demonstrations show.
    """
    network, settings = config.network, config.method
    assert isinstance(network, PolicyConfig) and isinstance(settings, MILConfig)
    _check_variant(settings, network, config.train.steps)
    _check_inner_loss(settings, network, has_goal_head=bool(network.goal_head and spec.goal_indices))
    sizes = spec.image_shape, spec.state_size, spec.action_size, len(spec.goal_indices)
    policy = make_policy(network, *sizes, config.recorded.history)
    return MIL(settings, policy, spec.goal_indices, calibration(config, spec), spec.class_indices)


def _check_variant(settings: MILConfig, network: PolicyConfig, steps: int) -> None:
    """Raises ValueError for a relative of MAML that does not exist, or has nothing to adapt or to count."""
    variant, inner_steps = settings.variant, settings.inner_steps
    if variant not in VARIANTS:
        raise ValueError(f"method.variant: got {variant!r}, expected one of {', '.join(VARIANTS)}")
    if variant == "cavia" and not network.bias_transformation:
        expected = "at least 1: method.variant='cavia' adapts it alone"
        raise ValueError(f"network.bias_transformation: got 0, expected {expected}")
    if variant == "anil" and (network.heads == 2 or network.learned_loss):
        expected = "one that acts and has the inner loss: method.variant='anil' adapts it alone"
        got = f"got {network.heads} with network.learned_loss={network.learned_loss!r}"
        raise ValueError(f"network.heads: {got}, expected {expected}")
    if variant == "multi_step" and inner_steps < 2:
        expected = "at least 2: method.variant='multi_step' counts them all"
        raise ValueError(f"method.inner_steps: got {inner_steps}, expected {expected}")
    if settings.imitation_steps >= steps:
        got = f"got {settings.imitation_steps}"
        raise ValueError(f"method.imitation_steps: {got}, expected less than train.steps = {steps}")


def _check_inner_loss(settings: MILConfig, network: PolicyConfig, has_goal_head: bool) -> None:
    """Raises ValueError where what demonstrations show does not fit the inner loss."""
    given, learned = settings.given, network.learned_loss
    if network.hindsight_head and not (has_goal_head and given == "video"):
        expected = "False: it is for a goal head, from video alone (method.given)"
        raise ValueError(f"network.hindsight_head: got True, expected {expected}")
    if learned not in (None, *KINDS):
        raise ValueError(f"network.learned_loss: got {learned!r}, expected None or one of {', '.join(KINDS)}")
    if (learned is None) != (given == GIVEN[0]):
        expected = "None: the actions are shown" if learned else f"one of {', '.join(KINDS)}: no actions are shown"
        raise ValueError(f"network.learned_loss: got {learned!r} with method.given={given!r}, expected {expected}")
