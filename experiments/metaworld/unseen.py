"""One-shot imitation of unseen kinds of tasks: each of Meta-World's 50 families is a task, and four are held out.

The protocol is that of AWDA (arXiv:2302.04856): 100 demonstrations of each family with various places of object and
goal, and four families that a policy is shown once and then does in 100 other places; success counts at any time of an
episode. Of the four, button-press and window-open are called easy there, door-unlock and pick-place-wall hard. There 46
families train; here two of them choose the checkpoint (`unseen.json`), and the images are smaller. In the environment
of `meta_world.py`:

    python -m milx.worlds.record unseen:make SET --splits=unseen.json --family=prefix --demos=100 --python=PYTHON
    python -m milx.evaluate RUN --gym=unseen:make --python=PYTHON --episodes=100
"""

import gymnasium
from meta_world import MetaWorld
from metaworld.policies import ENV_POLICY_MAP

STEPS = 490
"""Time steps of an episode; Meta-World allows 500, of which the hand wanders for some."""


def tasks() -> list[str]:
    """Lists the families."""
    return sorted(ENV_POLICY_MAP)


def make(task: str) -> gymnasium.Env:
    """Makes the environment of a family."""
    return MetaWorld(task, None, STEPS)
