"""Methods by name, built from a configuration and the sizes of what they see and do."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from milx.config.schema import GIVEN, VARIANTS, Config
from milx.methods.base import Method
from milx.methods.contextual import ContextPolicy
from milx.methods.mil import MIL
from milx.methods.whitening import Whitening
from milx.networks.attention import AttentiveActor, ObjectTokens
from milx.networks.encoders import Actor, LastFrame, Recurrent, make_context_network
from milx.networks.learned_loss import KINDS
from milx.networks.policy_network import make_policy
from milx.types import Params, Spec

__all__ = ["METHODS", "Method", "make", "params_like"]


def _make_mil(config: Config, spec: Spec) -> Method:
    network = make_policy(
        config.network, spec.image_shape, spec.state_size, spec.action_size, goal_size=len(spec.goal_indices)
    )
    return MIL(config.mil, network, spec.goal_indices, _calibration(config, spec))


def _make_contextual(config: Config, spec: Spec) -> Method:
    return _with_context(config, spec, LastFrame(config.network))


def _make_lstm(config: Config, spec: Spec) -> Method:
    return _with_context(config, spec, Recurrent(config.network))


def _make_lstm_attention(config: Config, spec: Spec) -> Method:
    if not spec.object_indices:
        raise ValueError(
            "method: got 'lstm_attention', expected another: the state does not tell where the objects are"
        )
    actor = AttentiveActor(config.network, spec.action_size, spec.object_indices)
    return _with_context(config, spec, ObjectTokens(config.network, spec.object_indices), actor)


def _with_context(config: Config, spec: Spec, encoder: Any, actor: Any = None) -> Method:
    actor = actor or Actor(config.network, spec.action_size, goal_size=len(spec.goal_indices))
    network = make_context_network(encoder, actor, spec.image_shape, spec.state_size, spec.action_size)
    return ContextPolicy(config.mil, network, spec.goal_indices, _calibration(config, spec))


def _calibration(config: Config, spec: Spec) -> tuple[tuple[float, ...], ...] | None:
    calibrated = config.network.goal_head and config.network.calibrate and spec.image_shape is not None
    return spec.image_to_goal if calibrated else None


METHODS: dict[str, Callable[[Config, Spec], Method]] = {
    "mil": _make_mil,
    "contextual": _make_contextual,
    "lstm": _make_lstm,
    "lstm_attention": _make_lstm_attention,
}


def make(config: Config, spec: Spec) -> Method:
    """Builds the method that `config.method_name` names.

    Raises:
        ValueError: for a name that does not exist (the message lists those that do), a method that needs to be told
            where the objects are and is not, or demonstrations that show too little for their use.
    """
    if config.method_name not in METHODS:
        raise ValueError(f"method: got {config.method_name!r}, expected one of {', '.join(METHODS)}")
    _check_given(config, spec)
    _check_variant(config)
    if config.network.fixed_filters is not None and spec.image_shape is None:
        expected = "None: this policy sees no pixels"
        raise ValueError(f"network.fixed_filters: got {config.network.fixed_filters!r}, expected {expected}")
    return METHODS[config.method_name](config, spec)


def params_like(method: Method, spec: Spec) -> Params:
    """Shapes and types of a method's parameters."""
    state, action = (jax.ShapeDtypeStruct((size,), np.float32) for size in (spec.state_size, spec.action_size))
    return jax.eval_shape(method.init, jax.random.key(0), Whitening(state, state, action, action))


def _check_variant(config: Config) -> None:
    """Raises ValueError for a relative of MAML that does not exist, or has nothing to adapt or to count."""
    variant, steps = config.mil.variant, config.mil.inner_steps
    if variant not in VARIANTS:
        raise ValueError(f"mil.variant: got {variant!r}, expected one of {', '.join(VARIANTS)}")
    if variant == "cavia" and not config.network.bias_transformation:
        raise ValueError("network.bias_transformation: got 0, expected at least 1: mil.variant='cavia' adapts it alone")
    if variant == "anil" and (config.network.heads == 2 or config.network.learned_loss):
        expected = "one that acts and has the inner loss: mil.variant='anil' adapts it alone"
        got = f"got {config.network.heads} with network.learned_loss={config.network.learned_loss!r}"
        raise ValueError(f"network.heads: {got}, expected {expected}")
    if variant == "multi_step" and steps < 2:
        raise ValueError(f"mil.inner_steps: got {steps}, expected at least 2: mil.variant='multi_step' counts them all")
    if config.network.target_head and config.method_name != "mil":
        got = f"got True with method {config.method_name!r}"
        raise ValueError(f"network.target_head: {got}, expected False: only MIL remembers the first image's target")
    if config.train.imitation_steps and config.method_name != "mil":
        got = f"got {config.train.imitation_steps} with method {config.method_name!r}"
        raise ValueError(f"train.imitation_steps: {got}, expected 0: only MIL has an inner step to leave out")
    if config.train.imitation_steps >= config.train.steps:
        got = f"got {config.train.imitation_steps}"
        raise ValueError(f"train.imitation_steps: {got}, expected less than train.steps = {config.train.steps}")


def _check_given(config: Config, spec: Spec) -> None:
    """Raises ValueError where what demonstrations show does not fit the policy or its inner loss."""
    given, learned = config.mil.given, config.network.learned_loss
    if given not in GIVEN:
        raise ValueError(f"mil.given: got {given!r}, expected one of {', '.join(GIVEN)}")
    if given == "video" and spec.image_shape is None:
        raise ValueError("mil.given: got 'video', expected the state, too: this policy sees no pixels")
    has_goal_head = config.network.goal_head and spec.goal_indices and config.method_name == "mil"
    if config.network.hindsight_head and not (has_goal_head and given == "video"):
        expected = "False: it is for MIL with a goal head, from video alone (mil.given)"
        raise ValueError(f"network.hindsight_head: got True, expected {expected}")
    if learned not in (None, *KINDS):
        raise ValueError(f"network.learned_loss: got {learned!r}, expected None or one of {', '.join(KINDS)}")
    if config.method_name == "mil" and (learned is None) != (given == GIVEN[0]):
        expected = "None: the actions are shown" if learned else f"one of {', '.join(KINDS)}: no actions are shown"
        raise ValueError(f"network.learned_loss: got {learned!r} with mil.given={given!r}, expected {expected}")
