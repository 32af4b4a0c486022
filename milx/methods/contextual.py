"""Contextual and recurrent policies: a demonstration becomes a context, and no parameter changes (paper, Section 6)."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from milx.config.schema import Config, MethodConfig
from milx.methods.base import Method
from milx.methods.imitation import behavioral_cloning, calibrate_goal_head, calibration, flat, shown
from milx.methods.whitening import Whitening
from milx.networks.attention import AttentionConfig, AttentiveActor, ObjectTokens
from milx.networks.encoders import (
    Actor,
    ContextConfig,
    ContextNetwork,
    LastFrame,
    Recurrent,
    RecurrentConfig,
    make_context_network,
)
from milx.networks.policy_network import goal_camera
from milx.types import Demo, Memory, Observation, Params, Spec, TaskBatch, TaskParams


@dataclasses.dataclass(frozen=True, eq=False)
class ContextPolicy(Method):
    """Imitates the query, told by the context of the support demonstration.

    `params` holds the network's parameters ("encoder", "actor") and the whitening. `task_params` holds the actor's, the
    whitening and the contexts of K demonstrations; with several the actions are averaged, as in the released code.

    Attributes:
        config: scale and weight of the losses.
        network: encoder and actor.
        goal_indices, image_to_goal: as in `MIL`.
    """

    config: MethodConfig
    network: ContextNetwork
    goal_indices: tuple[int, ...] = ()
    image_to_goal: tuple[tuple[float, ...], ...] | None = None
    class_indices: tuple[int, ...] = ()

    def init(self, key: jax.Array, whitening: Whitening) -> Params:
        """Draws the networks' parameters."""
        params = self.network.init(key)
        actor = calibrate_goal_head(params["actor"], self.image_to_goal, self.goal_indices, whitening)
        return {**params, "actor": actor, "whitening": whitening}

    def adapt(self, params: Params, demo: Demo) -> TaskParams:
        """Encodes demonstrations [K, T, ...]."""
        whitening = jax.lax.stop_gradient(params["whitening"])
        demo = shown(demo, self.config.given, whitening)

        def encode(image: jax.Array | None, state: jax.Array, action: jax.Array) -> Any:
            return self.network.encode(params, image, whitening.state(state), whitening.action(action))

        context = jax.vmap(encode)(demo.image, demo.state, demo.action)
        return {"actor": params["actor"], "whitening": params["whitening"], "context": context}

    def loss(
        self, params: Params, batch: TaskBatch, progress: jax.Array | float = 1.0
    ) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Computes the imitation loss of the queries, averaged over tasks and demonstrations, and its parts, [N]."""

        def task_loss(support: Demo, query: Demo) -> tuple[jax.Array, dict[str, jax.Array]]:
            task_params = self.adapt(params, support)
            whitening = jax.lax.stop_gradient(params["whitening"])
            seen = flat(query)

            def one(context: Any) -> tuple[jax.Array, dict[str, jax.Array]]:
                output = self.network.apply(task_params, context, seen.image, whitening.state(seen.state))
                indices = self.goal_indices, self.class_indices
                return behavioral_cloning(self.config, output, output.action, query, whitening, *indices)

            return jax.tree.map(jnp.mean, jax.vmap(one)(task_params["context"]))

        loss, metrics = jax.vmap(task_loss)(batch.support, batch.query)
        return loss.mean(), {"loss": loss, **metrics}

    def act(self, task_params: TaskParams, observation: Observation, memory: Memory) -> tuple[jax.Array, Memory]:
        """Averages the actor's actions over the contexts."""
        whitening, batch = task_params["whitening"], jax.tree.map(lambda x: x[None], observation)
        state = whitening.state(batch.state)
        apply = jax.vmap(lambda context: self.network.apply(task_params, context, batch.image, state).action[0])
        action = apply(task_params["context"]).mean(axis=0)
        return whitening.unwhiten_action(action, self.class_indices), memory


def make_contextual(config: Config, spec: Spec) -> ContextPolicy:
    """Builds the policy that sees a demonstration's last frame."""
    assert isinstance(config.network, ContextConfig)
    parts = LastFrame(config.network), _actor(config.network, spec)
    network = make_context_network(*parts, spec, config.recorded.history)
    return _with_context(config, spec, network)


def make_lstm(config: Config, spec: Spec) -> ContextPolicy:
    """Builds the policy whose LSTM reads a demonstration."""
    assert isinstance(config.network, RecurrentConfig)
    parts = Recurrent(config.network), _actor(config.network, spec)
    network = make_context_network(*parts, spec, config.recorded.history)
    return _with_context(config, spec, network)


def make_lstm_attention(config: Config, spec: Spec) -> ContextPolicy:
    """Builds the policy that attends to a demonstration and to the objects.

    Raises:
        ValueError: where the state does not tell where the objects are.
    """
    assert isinstance(config.network, AttentionConfig)
    if not spec.object_indices:
        expected = "another: the state does not tell where the objects are"
        raise ValueError(f"method: got 'lstm_attention', expected {expected}")
    actor = AttentiveActor(config.network, spec.action_size, spec.object_indices)
    network = make_context_network(ObjectTokens(config.network, spec.object_indices), actor, spec)
    return _with_context(config, spec, network)


def _actor(network: ContextConfig, spec: Spec) -> Actor:
    return Actor(network, spec.action_size, len(spec.goal_indices), goal_camera(spec.image_shape))


def _with_context(config: Config, spec: Spec, network: ContextNetwork) -> ContextPolicy:
    return ContextPolicy(config.method, network, spec.goal_indices, calibration(config, spec), spec.class_indices)
