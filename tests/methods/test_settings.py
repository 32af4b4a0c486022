"""What can be set is read: a method has no settings of networks that it does not have."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from milx import methods
from milx.config.assemble import default_config, make_config
from milx.config.check import check_config
from milx.config.registry import PRESETS
from milx.config.schema import ConvConfig
from milx.types import Demo, Spec, TaskBatch

IMAGE_SHAPE, STATE, ACTION = (8, 10), 7, 2
SPEC = Spec(
    image_shape=IMAGE_SHAPE,
    state_size=STATE,
    action_size=ACTION,
    action_range=((-1.0,) * ACTION, (1.0,) * ACTION),
    goal_indices=(1, 2),
    image_to_goal=((0.5, 0.0), (0.0, -0.5), (0.1, 0.2)),
    object_indices=((3, 4), (5, 6)),
)


@pytest.mark.parametrize("name", ["mil", "contextual", "lstm", "lstm_attention"])
def test_every_field_of_a_methods_networks_is_read(name, monkeypatch):
    """Traces the meta-training loss where there are images, goals and objects, and collects what is read."""
    config, read, spec = default_config(name), set(), SPEC
    image = jnp.zeros((2, 1, 3, *IMAGE_SHAPE, 3), jnp.uint8)
    if isinstance(config.network, ConvConfig):
        config.network.goal_head = True
        spec, image = dataclasses.replace(SPEC, image_shape=dict.fromkeys("ab", IMAGE_SHAPE)), {"a": image, "b": image}

    def record(self, field):
        read.add(field)
        return object.__getattribute__(self, field)

    monkeypatch.setattr(type(config.network), "__getattribute__", record, raising=False)
    method = methods.make(config, spec)
    state, action, goal = (jnp.zeros((2, 1, 3, size)) for size in (STATE, ACTION, 2))
    demo = Demo(image, state, action, goal)
    jax.eval_shape(method.loss, methods.params_like(method, spec), TaskBatch(demo, demo))
    assert {field.name for field in dataclasses.fields(config.network)} <= read


@pytest.mark.parametrize("preset", PRESETS["reach_state"])
def test_attention_to_objects_works_with_every_preset(preset):
    config = make_config("reach_state", "lstm_attention", preset)
    check_config(config)
    assert methods.params_like(methods.make(config, SPEC), SPEC)
