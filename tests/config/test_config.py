"""Configurations: to JSON and back, presets, and what is said about names that do not exist."""

import json
import re

import pytest

from milx import methods
from milx.config import schema
from milx.config.presets import PRESETS, make_config, overrides
from milx.config.schema import Config
from milx.types import Spec

ALL = [(env, preset) for env, presets in PRESETS.items() for preset in presets]


@pytest.mark.parametrize(("env", "preset"), ALL)
def test_json_and_back(env, preset):
    config = make_config(env, "mil", preset, seed=3)
    config.train.support_frames = None
    config.network.filters = tuple(5 + i for i in range(len(config.network.strides)))
    config.optimizer.clip_norm = 0.125
    again = schema.from_dict(json.loads(json.dumps(schema.to_dict(config))))
    assert again == config
    assert isinstance(again.network.filters, tuple)
    assert schema.differences(schema.to_dict(config), schema.to_dict(again)) == []


@pytest.mark.parametrize(("env", "preset"), ALL)
def test_presets_carry_their_names_and_share_nothing(env, preset):
    config = make_config(env, "mil", preset, seed=3)
    assert (config.env_name, config.method_name, config.preset, config.seed) == (env, "mil", preset, 3)
    before = make_config(env, "mil", preset)
    config.network.filters, config.data.tasks, config.evaluation.batch = (1,), -1, -1
    assert make_config(env, "mil", preset) == before
    assert config.train.eval_every % config.train.log_every == config.train.steps % config.train.eval_every == 0


def test_fields_left_out_have_their_defaults():
    config = schema.from_dict({"seed": 4, "train": {"steps": 7}})
    expected = Config(seed=4)
    expected.train.steps = 7
    assert config == expected


@pytest.mark.parametrize(
    ("values", "message", "valid"),
    [
        ({"nope": 1}, "config: no such field 'nope'", ["env_name", "seed", "train", "evaluation"]),
        ({"train": {"stepz": 1}}, "config.train: no such field 'stepz'", ["steps", "meta_batch", "eval_every"]),
        ({"train": {"&: 3": 1}}, "config.train: no such field '&: 3'", ["steps", "eval_every"]),
    ],
)
def test_unknown_field_is_refused_and_the_valid_ones_listed(values, message, valid):
    with pytest.raises(ValueError, match="^" + re.escape(message)) as error:
        schema.from_dict(values)
    listed = str(error.value).split("expected one of ")[1].split(", ")
    assert set(valid) <= set(listed)
    assert "nope" not in listed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env": "nope"}, "env: got 'nope', expected one of reach, push, place, reach_state"),
        ({"env": "reach", "preset": "nope"}, "preset: got 'nope', expected one of paper, fast, cpu"),
    ],
)
def test_unknown_env_or_preset_is_refused_and_the_valid_ones_listed(arguments, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        make_config(**arguments)


def test_unknown_method_is_refused_and_the_valid_ones_listed():
    spec = Spec(image_shape=(8, 10), state_size=4, action_size=2, action_range=((-1, -1), (1, 1)), goal_indices=(0,))
    with pytest.raises(
        ValueError, match=re.escape("method: got 'nope', expected one of mil, contextual, lstm, lstm_attention")
    ):
        methods.make(make_config("reach", "nope"), spec)


def test_differences_name_the_fields():
    old, new = make_config("reach", preset="cpu"), make_config("reach", preset="cpu", seed=2)
    old.train.meta_batch, new.train.meta_batch = 8, 9
    old.network.filters, new.network.filters = (24, 24), (1, 2)
    found = schema.differences(schema.to_dict(old), schema.to_dict(new))
    assert found == [
        "seed was 0, now 2",
        "network.filters was (24, 24), now (1, 2)",
        "train.meta_batch was 8, now 9",
    ]


def test_overrides_are_what_differs_from_the_preset():
    config = make_config("reach", preset="cpu", seed=3)
    assert overrides(config) == {}
    config.network.filters, config.mil.inner_steps = (1, 2), 5
    assert overrides(config) == {"network.filters": (1, 2), "mil.inner_steps": 5}


def test_fields_are_assigned_by_name_and_only_optional_ones_take_none():
    config = make_config("reach", preset="cpu")
    assert config.train.support_frames is not None
    schema.assign(config, "train.support_frames", None)
    schema.assign(config, "mil.inner_steps", 3)
    assert overrides(config) == {"train.support_frames": None, "mil.inner_steps": 3}
    with pytest.raises(ValueError, match=r"config\.train\.steps: got None, expected a value"):
        schema.assign(config, "train.steps", None)
    with pytest.raises(ValueError, match=r"config\.train\.stepz: no such field"):
        schema.assign(config, "train.stepz", 1)


@pytest.mark.parametrize(("env", "preset"), [pair for pair in ALL if pair[1] != "paper"])
def test_methods_that_do_not_imitate_the_demonstration_see_what_they_see_at_test(env, preset):
    """The last frame is all that a contextual policy looks at; a recurrent one must train on whole demonstrations."""
    frames = {method: make_config(env, method, preset).train.support_frames for method in methods.METHODS}
    assert (frames["contextual"], frames["lstm"], frames["lstm_attention"]) == (1, None, None)


def test_flatten_joins_names_with_dots():
    assert schema.flatten({"a": 1, "b": {"c": 2, "d": {"e": (3,)}}}) == {"a": 1, "b.c": 2, "b.d.e": (3,)}
