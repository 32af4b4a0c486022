"""What the tests of worlds share."""

import pytest
from follower import follower_policy


@pytest.fixture
def policy():
    return follower_policy()
