"""Training that starts from the arrays of a file."""

import jax
import numpy as np
import pytest
from safetensors.numpy import save_file

from milx import methods
from milx.config.assemble import make_config
from milx.core import pytrees
from milx.methods.whitening import Whitening
from milx.training.start import check_source, start_from
from milx.types import Spec

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
    started = pytrees.leaves(start_from(str(path), drawn))
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
        ({}, "which has none of the"),
    ],
)
def test_a_file_that_does_not_fit_is_an_error(drawn, tmp_path, arrays, message):
    path = tmp_path / "weights.safetensors"
    save_file(arrays, path)
    with pytest.raises(ValueError, match=message):
        start_from(str(path), drawn)


def test_a_file_is_checked_before_data_are_read(tmp_path, drawn):
    (tmp_path / "bad.safetensors").write_bytes(b"no tensors")
    for name in ("bad.safetensors", "missing.npz"):
        with pytest.raises(ValueError, match=rf"init: .*{name}:? cannot be read"):
            check_source(str(tmp_path / name), drawn)
    shapes = jax.eval_shape(lambda: drawn)
    save_file({KERNEL: np.zeros((5, 5, 3, 4))}, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match=r"kernel: got \(5, 5, 3, 4\), expected \(3, 3, 3, 4\)"):
        check_source(str(tmp_path / "other.safetensors"), shapes)
