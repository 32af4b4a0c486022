"""How a controller rehearses, on reach, where the tactic is the shoulder's motor command."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from milx.data.push_controller import Controlled
from milx.envs.reach.env import Reach


class Turning(Reach):
    """Success: the shoulder ends turned towards the first cube's side, if that is near."""

    def success(self, task, states):
        x, y, _ = states.mocap_pos[0, 0]
        return (x < 0.1) & (states.qpos[-1, 0] * jnp.sign(y) > 0.01)


def turn(env, task, state, tactic):
    return jnp.stack([tactic, 0.0])


@pytest.mark.slow
def test_the_controller_acts_by_the_first_tactic_that_succeeds_in_rehearsal():
    env, keys = Turning((8, 10)), jax.random.split(jax.random.key(3), 24)
    tasks = jax.vmap(env.sample_task, in_axes=(0, None))(keys, "train")
    scenes = jax.vmap(env.reset)(keys, tasks)
    x, y, _ = np.moveaxis(scenes.mocap_pos[:, 0], -1, 0)
    expected = np.where(x < 0.1, np.where(y > 0, 0.3, -0.3), 0.0)
    assert set(np.unique(expected)) == {-0.3, 0.0, 0.3}
    controller = Controlled(turn, (0.0, 0.3, -0.3, 0.6))
    np.testing.assert_array_equal(controller.choose(env, tasks, scenes), expected)
    _, action = controller.perform(env, tasks, scenes, keys, 0.05)
    np.testing.assert_allclose(action[..., 0], np.broadcast_to(expected[:, None], action.shape[:2]), rtol=1e-6)
