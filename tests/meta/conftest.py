"""The meta-learning core is tested in float64, on inputs from one seed."""

import jax
import numpy as np
import pytest


@pytest.fixture(autouse=True, scope="module")
def float64():
    with jax.enable_x64(True):
        yield


@pytest.fixture
def rng():
    return np.random.default_rng(0)
