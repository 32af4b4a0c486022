"""Training that starts from the arrays of a file, or from the parameters of a policy that ships with milx."""

import ast
import re

import jax
import numpy as np
import pytest
from safetensors.numpy import save_file
from tiny import QUIET

from milx import methods
from milx.config.assemble import assign, make_config
from milx.core import pytrees
from milx.data import RECORDED
from milx.data.dataset import Writer
from milx.deploy import pretrained
from milx.methods.whitening import Whitening
from milx.training import recorded
from milx.training.recorded import RecordedRun
from milx.training.start import check_source, start_from
from milx.training.state import initial_state
from milx.types import SPLITS, Demo, Spec

CONFIG = make_config("reach", preset="cpu")
"""Any configuration: a file is compared with the parameters alone."""
KERNEL, BIAS = "vision.ConvBlock_0.kernel", "controller.Dense_0.bias"


@pytest.fixture(scope="module", params=["contextual", "mil"])
def drawn(request):
    """Draws a policy: a contextual one has two encoders, and one of MIL has a learned inner rate for each parameter."""
    config = make_config("reach", request.param, "cpu")
    assert request.param == "contextual" or config.method.learn_inner_lr
    config.network.filters, config.network.strides, config.network.fc_layers = (4, 4), (2, 2), (8,)
    method = methods.make(config, Spec((8, 8), 3, 2, None, ()))
    return method.init(jax.random.key(0), Whitening(np.zeros(3), np.ones(3), np.zeros(2), np.ones(2)))


@pytest.mark.parametrize("ending", ["safetensors", "npz"])
def test_the_arrays_of_a_file_replace_the_parameters_whose_names_end_so(drawn, tmp_path, ending):
    path, rng = tmp_path / f"weights.{ending}", np.random.default_rng(0)
    kernel, bias = rng.standard_normal((3, 3, 3, 4), np.float32), rng.standard_normal(8, np.float32)
    write = {"safetensors": save_file, "npz": lambda arrays, path: np.savez(path, **arrays)}[ending]
    write({KERNEL: kernel, BIAS: bias}, path)
    started = pytrees.leaves(start_from(str(path), drawn, CONFIG))
    for name, value in pytrees.leaves(drawn).items():
        mine = not name.startswith("inner_log_lr")
        expected = kernel if mine and name.endswith(KERNEL) else bias if mine and name.endswith(BIAS) else value
        np.testing.assert_array_equal(started[name], expected, err_msg=name)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"vision.ConvBlock_7.kernel": np.zeros((3, 3, 3, 4))}, r"vision.ConvBlock_7.kernel: there is no such param"),
        (
            {"Block_0.kernel": np.zeros((3, 3, 3, 4))},
            r"Block_0.kernel: there is no such parameter, expected one",
        ),
        ({KERNEL: np.zeros((5, 5, 3, 4))}, r"kernel: got \(5, 5, 3, 4\), expected \(3, 3, 3, 4\), as "),
        ({KERNEL: np.full((3, 3, 3, 4), np.nan)}, "kernel: got values that are not finite"),
        ({KERNEL: np.zeros((3, 3, 3, 4)), f".{KERNEL}"[1:].partition(".")[2]: np.zeros((3, 3, 3, 4))}, "a second time"),
        ({}, "weights.safetensors: got no arrays, expected some of "),
    ],
)
def test_a_file_that_does_not_fit_is_an_error(drawn, tmp_path, arrays, message):
    path = tmp_path / "weights.safetensors"
    save_file(arrays, path)
    with pytest.raises(ValueError, match=message):
        start_from(str(path), drawn, CONFIG)


def test_a_file_is_checked_before_data_are_read(tmp_path, drawn):
    (tmp_path / "bad.safetensors").write_bytes(b"no tensors")
    for name in ("bad.safetensors", "missing.npz"):
        with pytest.raises(ValueError, match=rf"init: .*{name}:? cannot be read"):
            check_source(str(tmp_path / name), drawn, CONFIG)
    shapes = jax.eval_shape(lambda: drawn)
    save_file({KERNEL: np.zeros((5, 5, 3, 4))}, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match=r"kernel: got \(5, 5, 3, 4\), expected \(3, 3, 3, 4\)"):
        check_source(str(tmp_path / "other.safetensors"), shapes, CONFIG)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Writes one task of each split, with 2 demonstrations of 5 steps: images of 16 x 16, states of 4, actions of 4."""
    folder, rng = tmp_path_factory.mktemp("recording") / "set", np.random.default_rng(0)
    with Writer(folder, (16, 16), 4, 4, "a test") as writer:
        for split in SPLITS:
            vectors = rng.normal(size=(2, 2, 5, 4)).astype(np.float32)
            demos = [Demo(rng.integers(0, 256, (5, 16, 16, 3), np.uint8), *pair) for pair in vectors]
            writer.add(split, split, [5, 5], demos)
    return folder


def test_a_recorded_run_starts_from_what_fits_of_a_shipped_policy(folder, tmp_path, capsys):
    """Compares with the file of push: its states and actions have other sizes, and its convolutions the same."""
    config = recorded.config_for(folder, preset="fast")
    config.network.kernel = 5
    run = RecordedRun(config, tmp_path / "run", QUIET)
    training = run._load()
    drawn = pytrees.leaves(initial_state(run.trainer, config, training)[0].params)
    config.train.init = "push"
    started = pytrees.leaves(initial_state(run.trainer, config, training)[0].params)
    with np.load(pretrained.FOLDER / "push" / "params.npz") as arrays:
        push = dict(arrays)
    fitting = {name for name, value in drawn.items() if name in push and push[name].shape == value.shape}
    assert fitting > {f"policy.vision.ConvBlock_{i}.kernel" for i in range(4)}
    assert not [name for name in fitting if name.startswith("whitening")]
    for name, value in started.items():
        np.testing.assert_array_equal(value, push[name] if name in fitting else drawn[name], err_msg=name)
    count = len([name for name in drawn if not name.startswith("whitening")])
    said = f"milx: {len(fitting)} of {count} parameters start from push; all others are drawn\n"
    assert capsys.readouterr().out == said


def test_a_run_that_is_refused_leaves_its_folder_free(folder, tmp_path):
    """Begins again in the same folder with the settings that the message names."""
    config = recorded.config_for(folder, preset="cpu")
    config.train.init = "push"
    with pytest.raises(ValueError, match="none of whose kernels fits here"):
        RecordedRun(config, tmp_path / "run", QUIET)
    config.network.filters, config.network.kernel = (32, 32, 32, 32), 5
    assert RecordedRun(config, tmp_path / "run", QUIET).config == config


def shapes_of(config, image_shape=(64, 64)):
    """Returns the shapes of a policy's parameters; states and actions have 4 numbers each."""
    spec = Spec(image_shape, 4, 4, None, ())
    return methods.params_like(methods.make(config, spec), spec)


@pytest.mark.parametrize("source", ["push", "reach"])
def test_the_settings_that_a_message_names_make_all_convolutions_fit(source, capsys):
    """Sets what the message says that the preset `fast` needs; then nothing is left to say."""
    config = make_config(RECORDED, preset="fast")
    start_from(source, shapes_of(config), config)
    said = capsys.readouterr().out
    assert "all others are drawn, among them 4 of the 4 kernels of convolutions, which need network." in said
    for name, value in re.findall(r"(network\.\w+)=(\d+|\(.*?\))", said):
        assign(config, name, ast.literal_eval(value))
    started = pytrees.leaves(start_from(source, shapes_of(config), config))
    assert capsys.readouterr().out.endswith("all others are drawn\n")
    kernels = [name for name in started if re.search(r"vision\.ConvBlock_\d\.kernel", name) and started[name].ndim]
    _, theirs = pretrained.parameters(source)
    assert len(kernels) == len(config.network.filters)
    for name in kernels:
        np.testing.assert_array_equal(started[name], theirs[name], err_msg=name)


@pytest.mark.parametrize(
    ("history", "kernel", "image_shape", "said"),
    [
        (2, 5, (64, 64), "1 of the 4 kernels of convolutions, which need recorded.history=1, as push has"),
        (
            1,
            3,
            {"left": (64, 64), "right": (64, 64)},
            "8 of the 8 kernels of convolutions, which need network.share_encoder=True, network.kernel=5, as push has "
            "one encoder",
        ),
    ],
)
def test_convolutions_that_have_other_channels_or_names_are_told(history, kernel, image_shape, said, capsys):
    """Lets a policy with the kernels of push see two observations at once, or two cameras."""
    config = make_config(RECORDED, preset="fast")
    config.network.kernel, config.recorded.history = kernel, history
    start_from("push", shapes_of(config, image_shape), config)
    assert capsys.readouterr().out.endswith(f"; all others are drawn, among them {said}\n")
    config.network.share_encoder, config.network.kernel, config.recorded.history = True, 5, 1
    start_from("push", shapes_of(config, image_shape), config)
    assert capsys.readouterr().out.endswith("; all others are drawn\n")


@pytest.mark.parametrize(
    ("preset", "method", "image_shape", "expected"),
    [
        ("cpu", "mil", (64, 64), "network.filters=(32, 32, 32, 32), network.kernel=5, as push has"),
        ("cpu", "mil", None, "network.fc_layers=(200, 200, 200), as push has"),
        ("fast", "contextual", (64, 64), "the same method, cameras and layers: push has no actor.vision.ConvBlock_0"),
    ],
)
def test_a_policy_of_which_no_kernel_fits_is_refused(preset, method, image_shape, expected):
    """Refuses it before data are read, even where biases and inner learning rates would fit."""
    config = make_config(RECORDED, method, preset)
    if image_shape is None:
        config.network.filters = config.network.strides = ()
        config.network.soft_argmax = config.network.mixed_precision = False
    with pytest.raises(ValueError, match=re.escape(f"'push', none of whose kernels fits here, expected {expected}")):
        check_source("push", shapes_of(config, image_shape), config)
