"""Meta-World (Yu et al. 2019; the package metaworld 3) as a world for milx: six kinds of tasks with varied goals.

It runs in an environment of its own, as metaworld pins another mujoco than milx:

    python3 -m venv .mw && .mw/bin/pip install metaworld packaging
    cd experiments/metaworld
    python -m milx.worlds.record meta_world:make SET --python=../../.mw/bin/python --family=prefix

A task is a family and a number, which stands for a place of the object and of the goal: "reach-v3/17". Policies see one
camera, and the hand's position and opening; where the goal is, is hidden unless the object shows it. The images are
drawn by casting rays, so no OpenGL is needed. Demonstrations come from Meta-World's scripted policies; they begin in
various places and end five steps after the first success.
"""

import functools

import gymnasium
import metaworld
import mujoco
import numpy as np
from metaworld.policies import ENV_POLICY_MAP

FAMILIES = ("button-press-topdown-v3", "door-open-v3", "drawer-open-v3", "pick-place-v3", "push-v3", "reach-v3")
TASKS = 120
"""Tasks of every family; 50 come from every seed of Meta-World's."""
STEPS = 200
"""Time steps of an episode."""
PIXELS = 64
EYE, TARGET, FIELD = (0.85, 0.3, 0.62), (0.02, 0.72, 0.16), 42.0
"""Where the camera is (m), what it looks at, and its field of view (degrees): the table, seen over a corner of it."""
PLACES = 100
"""Places of object and goal where a task is a whole family; demonstrations have as many others."""
_AFTER, _WANDER = 5, 8
_DEMONSTRATION = {"demonstration": True}


def tasks() -> list[str]:
    """Lists the tasks."""
    return [f"{family}/{number}" for family in FAMILIES for number in range(TASKS)]


def make(task: str) -> gymnasium.Env:
    """Makes the environment of a task."""
    family, number = task.split("/")
    return MetaWorld(family, int(number))


@functools.lru_cache(maxsize=4)
def _benchmark(family: str, seed: int) -> metaworld.ML1:
    return metaworld.ML1(family, seed=seed)


class MetaWorld(gymnasium.Env):
    """One family. Observations are "image", uint8 [64, 64, 3], and "state", the hand's position (m) and opening [4].

    Args:
        family: as Meta-World calls it.
        number: the place of object and goal; None for another one whenever an episode or a demonstration begins, of
            `PLACES` each, which the seed chooses.
        steps: time steps of an episode.
    """

    def __init__(self, family: str, number: int | None, steps: int = STEPS):
        self._family, self._number, self._length = family, number, steps
        self._env = _benchmark(family, 0).train_classes[family]()
        self._put(number or 0)
        self._expert = ENV_POLICY_MAP[family]()
        self.action_space = self._env.action_space
        self.observation_space = gymnasium.spaces.Dict(
            {
                "image": gymnasium.spaces.Box(0, 255, (PIXELS, PIXELS, 3), np.uint8),
                "state": gymnasium.spaces.Box(-np.inf, np.inf, (4,), np.float64),
            }
        )
        self._seen: np.ndarray = np.zeros(39)
        self._steps = 0

    def _put(self, number: int) -> None:
        benchmark = _benchmark(self._family, number // 50)
        self._env.set_task(benchmark.train_tasks[number % 50])
        self._colors = _colors(self._env.model)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict]:
        """Starts an episode: the hand wanders for some steps, so that no two are the same."""
        super().reset(seed=seed)
        if self._number is None:
            shift = PLACES if options == _DEMONSTRATION else 0
            self._put(shift + (int(self.np_random.integers(PLACES)) if seed is None else seed % PLACES))
        self._seen, _ = self._env.reset(seed=seed)
        drift = self.np_random.uniform(-1, 1, 4)
        for _ in range(_WANDER):
            self._seen = self._env.step(np.array([*drift[:3], -1.0], np.float32))[0]
        self._steps = 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict]:
        """Does one step; `info["is_success"]` is Meta-World's own criterion."""
        self._seen, reward, *_, info = self._env.step(action)
        self._steps += 1
        success = bool(info["success"])
        return self._observation(), float(reward), False, self._steps >= self._length, {"is_success": success}

    def demonstrate(self, seed: int) -> dict[str, np.ndarray]:
        """Lets the scripted policy do the task, with some noise.

        Raises:
            RuntimeError: if it does not succeed.
        """
        observation, _ = self.reset(seed=seed, options=_DEMONSTRATION)
        shown: dict[str, list] = {"image": [], "state": [], "action": []}
        left = None
        while left != 0:
            if self._steps >= self._length:
                raise RuntimeError(f"the scripted policy has not succeeded within {self._length} steps")
            knowing = np.append(self._seen[:36], self._env._target_pos)  # the last three are hidden from policies
            action = self._expert.get_action(knowing) + self.np_random.normal(0, 0.05, 4)
            action = np.clip(action, -1, 1).astype(np.float32)
            for name, value in (*observation.items(), ("action", action)):
                shown[name].append(value)
            observation, *_, info = self.step(action)
            left = left - 1 if left is not None else _AFTER if info["is_success"] else None
        return {name: np.stack(values) for name, values in shown.items()}

    def close(self) -> None:
        """Ends the simulation."""
        self._env.close()

    def _observation(self) -> dict[str, np.ndarray]:
        return {"image": self._draw(), "state": self._seen[:4].copy()}

    def _draw(self) -> np.ndarray:
        """Casts a ray through every pixel; geoms have their colors, darker where they are farther away."""
        rays = _rays()
        geom, distance = np.zeros(len(rays), np.int32), np.zeros(len(rays))
        model, data = self._env.model, self._env.data
        mujoco.mj_multiRay(model, data, np.array(EYE), rays.ravel(), None, 1, -1, geom, distance, len(rays), 10.0)
        shade = np.clip(1.8 - 0.7 * distance, 0.4, 1.6)[:, None]
        image = np.where((geom >= 0)[:, None], self._colors[geom] * shade, 0.0)
        return (255 * np.clip(image, 0, 1)).astype(np.uint8).reshape(PIXELS, PIXELS, 3)


def _colors(model: mujoco.MjModel) -> np.ndarray:
    """Returns the colors [G, 3] of all geoms; a texture counts by its mean color."""
    colors = model.geom_rgba[:, :3].copy()
    for geom, material in enumerate(model.geom_matid):
        if material >= 0:
            colors[geom] = model.mat_rgba[material, :3]
            texture = model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB]
            if texture >= 0:
                channels, first = model.tex_nchannel[texture], model.tex_adr[texture]
                size = model.tex_height[texture] * model.tex_width[texture] * channels
                pixels = model.tex_data[first : first + size].reshape(-1, channels)
                colors[geom] *= pixels[:, :3].mean(axis=0) / 255
    return colors


@functools.cache
def _rays() -> np.ndarray:
    """Returns the directions [P, 3] through the pixels."""
    ahead = np.subtract(TARGET, EYE) / np.linalg.norm(np.subtract(TARGET, EYE))
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    y, x = (np.mgrid[:PIXELS, :PIXELS] + 0.5) * 2 / PIXELS - 1
    size = np.tan(np.deg2rad(FIELD) / 2)
    rays = ahead + size * (x[..., None] * right - y[..., None] * np.cross(right, ahead))
    return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3)
