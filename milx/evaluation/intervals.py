"""Intervals of success rates: over trials, and over the held-out things that the trials rest on."""

import math

import numpy as np

_RESAMPLES = 2000


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Computes Wilson's score interval of a success rate (Wilson 1927); 95% by default."""
    rate, spread = successes / trials, z * z / trials
    center = (rate + spread / 2) / (1 + spread)
    half = math.sqrt(rate * (1 - rate) * spread + spread * spread / 4) / (1 + spread)
    # Rounding must not put the rate itself outside.
    return max(min(center - half, rate), 0.0), min(max(center + half, rate), 1.0)


def bootstrap_interval(success: np.ndarray, kind: np.ndarray) -> tuple[float, float]:
    """Computes the 95% percentile interval of a success rate over kinds of objects, drawn with replacement.

    Trials with the same thing are not independent: how a policy does with things that it has never seen is known from
    as many things as there are, not as many trials (the cluster bootstrap; Davison and Hinkley 1997, Section 3.8).

    Args:
        success: [N, trials] of N tasks.
        kind: [N] whole numbers, the same for tasks with the same thing.
    """
    kinds, number = np.unique(np.asarray(kind), return_inverse=True)
    trials = np.bincount(number) * success.shape[1]
    successes = np.bincount(number, weights=np.asarray(success).sum(axis=1))
    drawn = np.random.default_rng(0).integers(0, len(kinds), (_RESAMPLES, len(kinds)))
    rates = successes[drawn].sum(axis=1) / trials[drawn].sum(axis=1)
    low, high = np.percentile(rates, [2.5, 97.5])
    return float(low), float(high)
