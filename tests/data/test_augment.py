"""Random changes of recorded images, against what NumPy makes of the same images."""

import jax
import numpy as np
import pytest

from milx.data.augment import augmented

IMAGES = np.random.default_rng(0).integers(0, 200, (3, 8, 9, 3), np.uint8)


def test_images_are_moved_and_their_edges_repeated():
    """Finds for every key the one place in the padded images from which all images of the demonstration are cut."""
    padded, places = np.pad(IMAGES, ((0, 0), (2, 2), (2, 2), (0, 0)), mode="edge"), set()
    for number in range(200):
        moved = np.asarray(augmented(IMAGES, jax.random.key(number), 2, 0.0))
        fits = [(y, x) for y in range(5) for x in range(5) if (padded[:, y : y + 8, x : x + 9] == moved).all()]
        assert len(fits) == 1
        places.add(fits[0])
    assert len(places) == 25, "every place, at 1 in 280 for one of them to lack by chance"


def test_channels_are_multiplied_by_factors_within_the_limits():
    factors = []
    for number in range(100):
        changed = np.asarray(augmented(IMAGES, jax.random.key(number), 0, 0.25), float)
        for channel in range(3):
            before, after = IMAGES[..., channel].astype(float), changed[..., channel]
            factor = (before * after).sum() / (before**2).sum()
            assert np.abs(after - before * factor).max() < 1, "rounding is all that is left"
            factors.append(factor)
    assert 0.75 - 0.01 < min(factors) < 0.77
    assert 1.23 < max(factors) < 1.25 + 0.01


def test_cameras_change_each_for_itself_and_without_changes_nothing_does():
    both = augmented({"a": IMAGES, "b": IMAGES}, jax.random.key(0), 2, 0.2)
    assert (np.asarray(both["a"]) != np.asarray(both["b"])).any()
    np.testing.assert_array_equal(augmented(IMAGES, jax.random.key(0), 0, 0.0), IMAGES)
    assert augmented(None, jax.random.key(0), 2, 0.2) is None


def test_bright_images_stay_within_the_range():
    """Multiplies white by more than 1 in about half of the channels, which would begin again at black."""
    white = np.full((1, 4, 4, 3), 255, np.uint8)
    changed = np.stack([augmented(white, jax.random.key(number), 0, 0.5) for number in range(40)])
    assert (changed == 255).mean() > 0.3
    assert changed.min() >= 127


def test_all_images_of_a_history_change_alike():
    """Changes three images side by side, and each of them alone with the same key."""
    several, key = np.random.default_rng(1).integers(0, 256, (4, 8, 9, 9), np.uint8), jax.random.key(3)
    changed = np.asarray(augmented(several, key, 2, 0.3))
    for first in (0, 3, 6):
        one = slice(first, first + 3)
        np.testing.assert_array_equal(changed[..., one], augmented(several[..., one], key, 2, 0.3))
    assert (changed != several).mean() > 0.9


@pytest.mark.parametrize("shift", [0, 1])
def test_images_are_cut_out_at_every_place(shift):
    """Finds the one place that all images are cut from, in the images or, if they are shifted too, the padded ones."""
    padded, count = np.pad(IMAGES, ((0, 0), (shift, shift), (shift, shift), (0, 0)), mode="edge"), 2 * (shift + 2) + 1
    places = set()
    for number in range(400):
        cut = np.asarray(augmented(IMAGES, jax.random.key(number), shift, 0.0, crop=2))
        fits = [(y, x) for y in range(count) for x in range(count) if (padded[:, y : y + 4, x : x + 5] == cut).all()]
        assert len(fits) == 1
        places.add(fits[0])
    assert len(places) == count**2, "every place, at 1 in 80 for one of 49 to lack by chance, with seeds that are fixed"
