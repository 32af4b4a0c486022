"""Methods by name, built from a configuration and the sizes of what they see and do."""

import dataclasses

import jax
import numpy as np

from milx.config.registry import METHODS, register_method
from milx.config.schema import GIVEN, Config, ConvConfig
from milx.methods.base import Method
from milx.methods.chunks import Chunked
from milx.methods.contextual import make_contextual, make_lstm, make_lstm_attention
from milx.methods.crop import Cropped, cropped_shape
from milx.methods.history import History
from milx.methods.mil import MILConfig, make_mil
from milx.methods.whitening import Whitening
from milx.networks.attention import AttentionConfig
from milx.networks.encoders import ContextConfig, RecurrentConfig
from milx.networks.policy_network import PolicyConfig
from milx.types import Params, Spec

__all__ = ["METHODS", "Method", "make", "params_like"]

_LAST_STEP, _ALL_STEPS = {"train.support_frames": 1}, {"train.support_frames": None}
"""What methods that do not imitate the demonstration see of it in training: as much as at test."""

register_method("mil", make_mil, PolicyConfig, MILConfig)
register_method("contextual", make_contextual, ContextConfig, overrides=_LAST_STEP)
register_method("lstm", make_lstm, RecurrentConfig, overrides=_ALL_STEPS)
register_method("lstm_attention", make_lstm_attention, AttentionConfig, overrides=_ALL_STEPS)


def make(config: Config, spec: Spec) -> Method:
    """Builds the method that `config.method_name` names.

    Raises:
        ValueError: for a name that does not exist (the message lists those that do), settings of another method, or
            settings that do not fit together or what the policy sees.
    """
    if config.method_name not in METHODS:
        raise ValueError(f"method: got {config.method_name!r}, expected one of {', '.join(METHODS)}")
    entry = METHODS[config.method_name]
    for field, expected in (("network", entry.network), ("method", entry.method)):
        if type(got := getattr(config, field)) is not expected:
            expects = f"{expected.__name__} for method {config.method_name!r}"
            raise ValueError(f"{field}: got {type(got).__name__}, expected {expects}")
    if config.method.given not in GIVEN:
        raise ValueError(f"method.given: got {config.method.given!r}, expected one of {', '.join(GIVEN)}")
    if config.method.given == "video" and spec.image_shape is None:
        raise ValueError("method.given: got 'video', expected the state, too: this policy sees no pixels")
    fixed = config.network.fixed_filters if isinstance(config.network, ConvConfig) else None
    if fixed is not None and spec.image_shape is None:
        raise ValueError(f"network.fixed_filters: got {fixed!r}, expected None: this policy sees no pixels")
    history, crop = config.recorded.history, config.recorded.crop
    if fixed is not None and history > 1:
        expects = f"None: its filters see one image, and the policy recorded.history = {history} at once"
        raise ValueError(f"network.fixed_filters: got {fixed!r}, expected {expects}")
    chunk, execute = config.method.chunk, config.method.execute
    if execute > chunk:
        raise ValueError(f"method.execute: got {execute}, expected at most method.chunk = {chunk}")
    whole = dataclasses.replace(
        spec,
        image_shape=cropped_shape(spec.image_shape, crop),
        state_size=history * spec.state_size,
        action_size=chunk * spec.action_size,
        class_indices=classes(config, spec),
    )
    method = entry.make(config, whole)
    assert isinstance(method, Method)
    if crop:
        method = Cropped(method, crop)
    if history > 1:
        method = History(method, history, spec.image_shape, spec.state_size)
    return method if chunk == 1 else Chunked(method, chunk, execute, spec.action_size, spec.class_indices)


def classes(config: Config, spec: Spec) -> tuple[int, ...]:
    """Lists the entries of what a method predicts, an action or a chunk of them, that take two values."""
    return tuple(step * spec.action_size + i for step in range(config.method.chunk) for i in spec.class_indices)


def params_like(method: Method, spec: Spec) -> Params:
    """Returns shapes and types of a method's parameters."""
    sizes = method.history * spec.state_size, method.chunk * spec.action_size
    state, action = (jax.ShapeDtypeStruct((size,), np.float32) for size in sizes)
    return jax.eval_shape(method.init, jax.random.key(0), Whitening(state, state, action, action))
