"""What a planner by sampling chooses in each time step, instead of the actions themselves."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax


@dataclasses.dataclass(frozen=True, eq=False)
class Steering:
    """k controls that an environment turns into actions.

    Attributes:
        low: their lowest values, [k].
        high: their highest values, [k].
        deviation: standard deviation of what the planner tries first, [k] in the same units. Controls should be scaled
            so that it is about 0.3 for most of them, since a search does not become narrower than 0.03
            (`planner.SEARCH`).
        action: maps a `State` and controls [k] to an action [A], which is clipped afterwards.
        correction: maps the state that was reached and the state that the plan expected to what is added to the
            controls [k], so that the robot returns to its path; the sum may exceed `low` and `high`.
    """

    low: jax.Array
    high: jax.Array
    deviation: jax.Array
    action: Callable[[Any, jax.Array], jax.Array]
    correction: Callable[[Any, Any], jax.Array]
