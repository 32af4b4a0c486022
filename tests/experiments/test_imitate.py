"""What a network of the state learns from demonstrations, where the answer is known."""

import pathlib
import sys

import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "experiments" / "planning"))
import imitate


def test_a_linear_expert_is_imitated_in_its_own_units(monkeypatch):
    """Learns two actions of very different size and offset, of which two hundredths of the variance are noise."""
    monkeypatch.setattr(imitate, "BATCH", 256)
    monkeypatch.setattr(imitate, "WIDTH", 64)
    rng = np.random.default_rng(0)
    weights = rng.normal(size=(5, 2)) * [100.0, 0.01]
    act = lambda features: features @ weights + [500.0, -0.2]  # noqa: E731
    features, new = rng.normal(3.0, 2.0, (4000, 5)), rng.normal(3.0, 2.0, (1000, 5))
    noise = 0.02**0.5 * act(features).std(axis=0) * rng.normal(size=(4000, 2))
    imitator = imitate.fit(features, act(features) + noise, 600, 0)
    off = np.square(np.asarray(imitator.action(new)) - act(new)).mean(axis=0) / act(new).var(axis=0)
    assert (off < 0.02).all(), "less than the noise"
