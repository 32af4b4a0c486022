"""The shapes of the things that tasks are about: 105 for training, 10 for validation and 11 for testing.

What is held out is a kind of thing, not another size of one that was trained on. A line in `figures.py` or `things.py`
adds a shape.
"""

from milx.envs.shapes.figures import LETTERS, SIGNS, TURNED
from milx.envs.shapes.primitives import Shape
from milx.envs.shapes.things import ANIMALS, HOUSEHOLD, TOOLS, VEHICLES

SHAPES: dict[str, Shape] = LETTERS | SIGNS | TURNED | ANIMALS | TOOLS | HOUSEHOLD | VEHICLES
"""All shapes by name."""

TEST = (
    *("letter_k", "anchor", "knight", "elephant", "giraffe", "scissors"),
    *("umbrella", "banana", "teapot", "helicopter", "spanner"),
)
VALIDATION = ("letter_y", "trident", "lamp", "hedgehog", "octopus", "axe", "ladle", "sofa", "pear", "tractor")
BY_SPLIT: dict[str, tuple[str, ...]] = {
    "train": tuple(name for name in SHAPES if name not in TEST + VALIDATION),
    "validation": VALIDATION,
    "test": TEST,
}
"""The names of every split's shapes."""
