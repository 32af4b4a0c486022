"""milx's environments with Gymnasium's interface, one world at a time.

    env = milx.gym.GymEnv("reach", split="test")
    observation, info = env.reset(seed=0)
    demo = env.demonstrate()  # the same task in another scene: a policy adapts to this
    observation, reward, terminated, truncated, info = env.step(action)

Importing this module registers the environments with Gymnasium, which then also makes them itself, as
`gymnasium.make("milx/Push-v0")`, or without an import before, `gymnasium.make("milx.gym:milx/Push-v0")`.

To run thousands of episodes at once, use the environment itself (`milx.make`) under `jax.vmap`.
"""

from typing import Any, SupportsFloat

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces

from milx import envs
from milx.config.assemble import make_config
from milx.config.schema import DataConfig
from milx.data.experts import expert_of
from milx.data.simulated import render_demo
from milx.envs.base import State
from milx.types import SPLITS, Demo


class GymEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """An environment of milx, stepped by MJX in JAX. An episode never terminates; it is truncated at the horizon.

    Observations are dictionaries with "state", float32 [S], and, if policies see pixels, "image", uint8 [H, W, 3]. The
    reward of a step is minus the experts' running cost. After the last step, `info["is_success"]` says whether the
    episode succeeded.

    Args:
        name: a key of `milx.ENVS`.
        split: the split that tasks are sampled from: "train", "validation" or "test".
        image_shape: (H, W) in pixels; None for that of the published experiment.
        render_mode: "rgb_array" or None.

    Raises:
        ValueError: for a name, split or render mode that does not exist.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        name: str = "reach",
        split: str = "train",
        image_shape: tuple[int, int] | None = None,
        render_mode: str | None = None,
    ):
        if split not in SPLITS:
            raise ValueError(f"split: got {split!r}, expected one of {', '.join(SPLITS)}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode: got {render_mode!r}, expected None or 'rgb_array'")
        self.env, self.split, self.render_mode = envs.make(name, image_shape), split, render_mode
        low, high = (np.asarray(limit, np.float32) for limit in self.env.action_range)
        self.action_space = spaces.Box(low, high)
        self._seen: dict[str, spaces.Space] = {"state": spaces.Box(-np.inf, np.inf, (self.env.state_size,))}
        if self.env.vision:
            self._seen["image"] = spaces.Box(0, 255, (*self.env.image_shape, 3), np.uint8)
        self.observation_space = spaces.Dict(self._seen)  # type: ignore[assignment]
        self._task: Any = None
        self._states: list[State] = []
        self._draw = jax.jit(lambda key: self.env.sample_task(key, split))
        self._reset, self._render = jax.jit(self.env.reset), jax.jit(self.env.render)
        self._success = jax.jit(self.env.success)
        self._cost = jax.jit(lambda *args: 0.5 * jnp.square(self.env.running_residual(*args)).sum())

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Samples a task and a scene; with options={"same_task": True}, keeps the task and samples only a scene."""
        super().reset(seed=seed)
        if self._task is None or not (options or {}).get("same_task", False):
            self._task = self._draw(self._key())
        self._states = [self._reset(self._key(), self._task)]
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], SupportsFloat, bool, bool, dict[str, Any]]:
        """Applies the action for one time step."""
        t, state, chosen = len(self._states) - 1, self._states[-1], jnp.asarray(action, jnp.float32)
        cost = self._cost(self._task, state, chosen, jnp.asarray(t))
        self._states.append(self.env.step(self._task, state, chosen))
        truncated, info = len(self._states) > self.env.horizon, {}
        if truncated:
            states = jax.tree.map(lambda *x: jnp.stack(x), *self._states[: self.env.horizon + 1])
            info["is_success"] = bool(self._success(self._task, states))
        return self._observe(), -float(cost), False, truncated, info

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Returns the camera's image, [H, W, 3] uint8; None if `render_mode` is None."""
        return None if self.render_mode is None else np.asarray(self._render(self._task, self._states[-1]))

    def demonstrate(self, config: DataConfig | None = None) -> Demo:
        """Demonstrates the current task in another scene with an expert.

        Args:
            config: settings of the expert; None for those of the preset `fast`.

        Returns:
            A demonstration [T, ...] of NumPy arrays.

        Raises:
            ValueError: as `expert_of`.
        """
        config = config or make_config(self.env.name, preset="fast").data
        scene = self._reset(self._key(), self._task)
        task, state, key = jax.tree.map(lambda x: x[None], (self._task, scene, self._key()))
        planned = expert_of(self.env, config).perform(self.env, task, state, key, config.noise)
        states, action = jax.tree.map(lambda x: x[0], planned)
        return jax.tree.map(np.asarray, jax.jit(render_demo, static_argnums=0)(self.env, self._task, states, action))

    def _key(self) -> jax.Array:
        return jax.random.key(int(self.np_random.integers(2**31)))

    def _observe(self) -> dict[str, np.ndarray]:
        seen = self.env.observe(self._task, self._states[-1])
        values = {"image": seen.image, "state": seen.state}
        return {name: np.asarray(values[name], space.dtype) for name, space in self._seen.items()}


IDS = {
    "reach": "milx/Reach-v0",
    "reach_state": "milx/ReachState-v0",
    "push": "milx/Push-v0",
    "place": "milx/Place-v0",
    "grasp": "milx/Grasp-v0",
}
"""What Gymnasium calls milx's environments."""

for _name, _id in IDS.items():
    gymnasium.register(_id, entry_point="milx.gym:GymEnv", kwargs={"name": _name})
