"""Configurations: to JSON and back, presets, and what is said about names that do not exist."""

import json
import pathlib
import re

import pytest

import milx
from milx import methods
from milx.config import assemble, registry
from milx.config.assemble import default_config, make_config, overrides
from milx.config.check import check_config
from milx.config.registry import PRESETS
from milx.config.schema import DataConfig
from milx.types import Spec

ALL = [(env, preset) for env, presets in PRESETS.items() for preset in presets]


@pytest.mark.parametrize(("env", "preset"), ALL)
def test_json_and_back(env, preset):
    config = make_config(env, "mil", preset, seed=3)
    config.train.support_frames = None
    config.network.filters = tuple(5 + i for i in range(len(config.network.strides)))
    config.optimizer.clip_norm = 0.125
    again = assemble.from_dict(json.loads(json.dumps(assemble.to_dict(config))))
    assert again == config
    assert isinstance(again.network.filters, tuple)
    assert assemble.differences(assemble.to_dict(config), assemble.to_dict(again)) == []


@pytest.mark.parametrize(("env", "preset"), ALL)
def test_presets_carry_their_names_and_share_nothing(env, preset):
    config = make_config(env, "mil", preset, seed=3)
    assert (config.env_name, config.method_name, config.preset, config.seed) == (env, "mil", preset, 3)
    before = make_config(env, "mil", preset)
    config.network.filters, config.data.tasks, config.evaluation.batch = (1,), -1, -1
    assert make_config(env, "mil", preset) == before
    assert config.train.eval_every % config.train.log_every == config.train.steps % config.train.eval_every == 0


def test_fields_left_out_have_their_defaults():
    config = assemble.from_dict({"seed": 4, "train": {"steps": 7}})
    expected = default_config("mil")
    expected.seed, expected.train.steps = 4, 7
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
        assemble.from_dict(values)
    listed = str(error.value).split("expected one of ")[1].split(", ")
    assert set(valid) <= set(listed)
    assert "nope" not in listed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"env": "nope"}, "env: got 'nope', expected one of reach, reach_state, push, place"),
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
    found = assemble.differences(assemble.to_dict(old), assemble.to_dict(new))
    assert found == [
        "seed was 0, now 2",
        "network.filters was (24, 24), now (1, 2)",
        "train.meta_batch was 8, now 9",
    ]


def test_overrides_are_what_differs_from_the_preset():
    config = make_config("reach", preset="cpu", seed=3)
    assert overrides(config) == {}
    config.network.filters, config.method.inner_steps = (1, 2), 5
    assert overrides(config) == {"network.filters": (1, 2), "method.inner_steps": 5}


def test_fields_are_assigned_by_name_and_only_optional_ones_take_none():
    config = make_config("reach", preset="cpu")
    assert config.train.support_frames is not None
    assemble.assign(config, "train.support_frames", None)
    assemble.assign(config, "method.inner_steps", 3)
    assert overrides(config) == {"train.support_frames": None, "method.inner_steps": 3}
    with pytest.raises(ValueError, match=r"config\.train\.steps: got None, expected a value"):
        assemble.assign(config, "train.steps", None)
    with pytest.raises(ValueError, match=r"config\.train\.stepz: no such field"):
        assemble.assign(config, "train.stepz", 1)


@pytest.mark.parametrize("seed", [0, 2**32 - 1])
def test_every_seed_that_the_field_allows_is_accepted(seed):
    check_config(make_config("reach", preset="cpu", seed=seed))
    expected = "seed: got 4294967296, expected a whole number, at least 0 and at most 4294967295"
    with pytest.raises(ValueError, match=expected):
        check_config(make_config("reach", preset="cpu", seed=2**32))


@pytest.mark.parametrize(("env", "preset"), [pair for pair in ALL if pair[1] != "paper"])
def test_methods_that_do_not_imitate_the_demonstration_see_what_they_see_at_test(env, preset):
    """Expects the last frame for a contextual policy and whole demonstrations for a recurrent one."""
    frames = {method: make_config(env, method, preset).train.support_frames for method in methods.METHODS}
    assert (frames["contextual"], frames["lstm"], frames["lstm_attention"]) == (1, None, None)


def test_flatten_joins_names_with_dots():
    assert assemble.flatten({"a": 1, "b": {"c": 2, "d": {"e": (3,)}}}) == {"a": 1, "b.c": 2, "b.d.e": (3,)}


@pytest.mark.parametrize(("env", "preset"), ALL)
def test_presets_name_fields_that_some_method_has(env, preset):
    known = {name for method in methods.METHODS for name in assemble.fields(default_config(method))}
    assert set(PRESETS[env][preset]) <= known


def test_a_preset_with_a_field_that_no_method_has_is_refused(monkeypatch):
    monkeypatch.setitem(PRESETS, "mine", {"fast": {"train.stepz": 7}})
    with pytest.raises(ValueError, match=r"config\.train\.stepz: no such field"):
        make_config("mine", preset="fast")


def test_a_name_is_registered_once():
    with pytest.raises(ValueError, match="method: 'lstm' is registered already, expected a name that is free"):
        registry.register_method("lstm", make=None)


RESULTS = pathlib.Path(__file__).parents[2] / "experiments" / "results"
SHIPPED = pathlib.Path(milx.__file__).parent / "deploy" / "weights"


def test_configurations_of_all_results_and_shipped_policies_load():
    """Loads files of all layouts, from before methods had settings of their own on."""
    files, versions = [*RESULTS.rglob("*.json"), *SHIPPED.rglob("result.json")], set()
    configs = [content["config"] for content in map(_read, files) if isinstance(content, dict) and "config" in content]
    for values in configs:
        config, old = assemble.from_dict(values), assemble.flatten(values)
        versions.add(values.get("config_version", 1))
        for name, value in assemble.fields(config).items():
            if (name, value) == ("data.expert", "controller"):
                assert old["data.plan_iterations"] == 0
                continue
            before = [group.replace("method.", "mil.") for group in (name, name.replace("method.imi", "train.imi"))]
            found = [old[each] for each in (name, *before) if each in old]
            assert not found or all(_as_json(value) == each for each in found), name
    assert len(configs) > 200 and 1 in versions


def _read(path):
    return json.loads(path.read_text())


def _as_json(value):
    return json.loads(json.dumps(value))


def test_settings_that_attention_had_in_version_2_are_dropped():
    network = {"filters": [], "strides": [], "kernel": 3, "goal_head": True, "fc_layers": [16], "context": 8}
    values = {"config_version": 2, "method_name": "lstm_attention", "network": network}
    expected = default_config("lstm_attention")
    expected.network.fc_layers, expected.network.context = (16,), 8
    assert assemble.from_dict(values) == expected
    assert assemble.from_dict(values | {"method_name": "contextual"}).network.goal_head
    with pytest.raises(ValueError, match=r"config\.network: no such field 'filters', expected one of fc_layers"):
        assemble.from_dict(values | {"config_version": 3})


def test_the_controller_of_version_3_is_an_expert_with_a_name():
    values = {"config_version": 3, "data": {"plan_iterations": 0, "noise": 0.1}}
    assert assemble.from_dict(values).data == DataConfig(expert="controller", plan_iterations=0, noise=0.1)
    for data in ({"plan_iterations": 1}, {"plan_iterations": 0, "expert": "sampling"}):
        assert assemble.from_dict(values | {"data": data}).data.expert == data.get("expert", "ilqr")


def test_an_unknown_field_is_ignored_if_it_is_none():
    values = assemble.to_dict(default_config("mil"))
    values["env"]["goal_within"] = None
    assert assemble.from_dict(values) == default_config("mil")
    values["env"]["goal_within"] = 0.08
    with pytest.raises(ValueError, match=r"config\.env: no such field 'goal_within', expected one of image_shape"):
        assemble.from_dict(values)


def test_a_method_that_is_no_name_is_refused():
    with pytest.raises(ValueError, match="method"):
        assemble.from_dict({"method_name": [1]})


def test_a_later_layout_is_refused():
    with pytest.raises(ValueError, match="config_version: got 99, expected at most 4: made by a later milx"):
        assemble.from_dict({"config_version": 99})
