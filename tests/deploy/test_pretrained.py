"""Policies that ship with milx are those whose results they carry."""

import json
import pathlib
import shutil

import jax
import numpy as np
import pytest

import milx
from milx.config import assemble
from milx.config.assemble import make_config
from milx.core import pytrees
from milx.deploy import pretrained
from milx.deploy.policy import Policy


@pytest.mark.slow
@pytest.mark.parametrize("name", ["place", "push", "reach"])
def test_a_shipped_policy_is_adapted_by_its_demonstration(name):
    """Compares success with the task-blind expert's, actions after two demonstrations, and actions with stored ones."""
    policy = milx.load(name)
    result = pretrained.result(name)
    assert result["wilson95"][0] > result["baselines"]["task_blind"]
    assert result["params_hash"] == pytrees.fingerprint(policy.params)
    spec, rng = policy.spec, np.random.default_rng(0)
    state = np.asarray(policy.params["whitening"].state_mean)
    image = rng.integers(0, 256, (2, 6, *spec.image_shape, 3), np.uint8)
    action = np.zeros((6, spec.action_size), np.float32)
    seen = milx.Observation(image[0, 0], state)
    actions = []
    for shown in image:
        task_params = policy.adapt(policy.params, milx.Demo(shown, np.tile(state, (6, 1)), action))
        actions.append(np.asarray(policy.act(task_params, seen)))
    assert np.isfinite(actions).all()
    assert np.abs(actions[0] - actions[1]).max() > 1e-4
    stored = json.loads((pathlib.Path(__file__).parents[1] / "fixtures" / "actions.json").read_text())[name]
    np.testing.assert_allclose(actions, stored, rtol=0, atol=2e-3, err_msg=f"{np.array(actions).tolist()}")


@pytest.mark.parametrize("name", ["place", "push", "reach"])
def test_the_parameters_of_a_shipped_policy_are_those_that_it_has(name):
    config, arrays = pretrained.parameters(name)
    policy = milx.load(name)
    expected = pytrees.leaves(policy.params)
    assert config == policy.config
    assert list(arrays) == list(expected)
    for array, value in zip(arrays.values(), expected.values(), strict=True):
        np.testing.assert_array_equal(array, value)


def test_the_parameters_of_a_run_are_those_of_its_policy(trained):
    config, arrays = pretrained.parameters(trained.folder)
    assert config == trained.config
    assert pytrees.fingerprint(arrays) == pytrees.fingerprint(pytrees.leaves(milx.load(trained.folder).params))


def test_no_other_policies_ship():
    assert pretrained.names() == ["place", "push", "reach"]


def test_what_is_saved_is_loaded(tmp_path, monkeypatch):
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    config = make_config("reach_state", preset="cpu")
    spec = milx.make("reach_state").spec
    method = milx.methods.make(config, spec)
    like = milx.methods.params_like(method, spec)
    rng = np.random.default_rng(0)
    params = jax.tree.map(lambda x: rng.normal(size=x.shape).astype(x.dtype), like)
    pretrained.save(Policy(method, spec, params, config), {"config": assemble.to_dict(config)}, tmp_path / "mine")
    loaded = milx.load("mine")
    jax.tree.map(np.testing.assert_array_equal, loaded.params, params)
    assert loaded.config == config
    with pytest.raises(ValueError, match=r"run: got 'yours', expected the folder of a run, or one of mine, which ship"):
        milx.load("yours")


def test_parameters_that_have_changed_are_refused(tmp_path, monkeypatch):
    """Replaces the shipped parameters by zeros of the same shapes."""
    shutil.copytree(pretrained.FOLDER / "reach", tmp_path / "reach")
    monkeypatch.setattr(pretrained, "FOLDER", tmp_path)
    params = milx.load("reach").params
    pytrees.write(tmp_path / "reach" / "params.npz", jax.tree.map(np.zeros_like, params))
    for read in (milx.load, pretrained.parameters):
        with pytest.raises(ValueError, match=r"params\.npz: has changed, expected the parameters that ship with milx"):
            read("reach")


def test_a_folder_of_the_same_name_comes_first_and_is_reported(trained, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "reach").symlink_to(trained.folder)
    assert milx.load("reach").config == trained.config
    assert "loading the run in ./reach, not the policy 'reach' that ships with milx" in capsys.readouterr().err
