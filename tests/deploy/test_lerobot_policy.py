"""Policies in LeRobot's evaluation loop, against milx's own acting on the same observations.

Tests marked `lerobot` run LeRobot's own loop.
"""

import importlib
import re
import sys
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import milx
from milx import methods
from milx.config.assemble import make_config
from milx.data import RECORDED
from milx.deploy import standalone
from milx.deploy.batched import Batched, observations
from milx.deploy.policy import Policy
from milx.export import export
from milx.methods.whitening import Whitening
from milx.types import Demo, Observation, Spec
from milx.worlds.actor import Actor
from milx.worlds.slot import Episode, Outcome, Task

PAGE = Path(__file__).parents[2] / "docs" / "how_to" / "your_own_demonstrations.md"
SIZES = {"scene": (12, 16), "hand": (8, 8)}
S, A, CHUNK, WORLDS, LENGTH = 3, 2, 3, 3, 7
RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def policy():
    """Makes an untrained policy with two cameras that does the mean of all chunks it remembers."""
    config, spec = make_config(RECORDED, preset="cpu"), Spec(SIZES, S, A, None, ())
    config.recorded.path, config.recorded.horizon = "somewhere", 6
    config.network.filters, config.network.strides, config.network.fc_layers = (4, 4), (2, 1), (8,)
    config.method.chunk, config.method.execute = CHUNK, 0
    whitening = Whitening(jnp.full(S, 0.2), jnp.full(S, 2.0), jnp.full(CHUNK * A, 0.1), jnp.full(CHUNK * A, 0.3))
    method = methods.make(config, spec)
    return Policy(method, spec, jax.jit(method.init)(jax.random.key(0), whitening), config)


@pytest.fixture(scope="module")
def demos():
    """Makes demonstrations of two tasks."""
    pictures = lambda size: RNG.integers(0, 256, (9, *size, 3), np.uint8)  # noqa: E731
    vectors = lambda size: RNG.normal(size=(9, size)).astype(np.float32)  # noqa: E731
    return [Demo({name: pictures(size) for name, size in SIZES.items()}, vectors(S), vectors(A)) for _ in range(2)]


def random_observation():
    image = {name: RNG.integers(0, 256, (*size, 3), np.uint8) for name, size in SIZES.items()}
    return Observation(image, RNG.normal(size=S).astype(np.float32))


def batch_of(seen):
    """Writes observations of several environments as LeRobot does."""
    batch = {"observation.state": np.stack([each.state for each in seen])}
    for name in SIZES:
        images = np.stack([each.image[name] for each in seen])
        batch[f"observation.images.{name}"] = images.transpose(0, 3, 1, 2).astype(np.float32) / 255
    return batch


def acted(policy, demo, episode):
    """Returns the actions [T, B, A] of `milx.worlds` in an episode of several worlds, [T][B] observations."""
    actor, first = Actor(policy, [Task("a", demos=(demo,))], len(episode[0])), Episode("own", 0, 0)
    for world in range(len(episode[0])):
        actor.assign(world, first)
    return np.stack([actor.act(seen, [Outcome(first)] * len(seen)) for seen in episode])


@pytest.mark.parametrize("is_exported", [False, True], ids=["loaded", "exported"])
def test_a_batch_acts_as_in_worlds(policy, demos, tmp_path, is_exported):
    """Compares two episodes after one demonstration, and one after another demonstration."""
    own = policy
    if is_exported:
        export(policy, tmp_path / "out")
        own = standalone.Policy(tmp_path / "out")
    batched = Batched(own)
    found = []
    for demo in (demos[0], None, demos[1]):
        batched.reset(demo)
        episode = [[random_observation() for _ in range(WORLDS)] for _ in range(5)]
        found.append(np.stack([batched.act(batch_of(seen)) for seen in episode]))
        expected = acted(policy, demos[0] if demo is None else demo, episode)
        np.testing.assert_allclose(found[-1], expected, atol=1e-5)
    other = acted(policy, demos[0], episode)
    assert np.abs(found[-1] - other).max() > 1e-3, "the demonstration changes actions by more than the tolerance"
    assert np.abs(found[0][:, 0] - found[0][:, 1]).max() > 1e-3, "and so do observations"


def test_images_come_back_to_the_bit_in_milx_s_layout():
    """Writes every level as LeRobot does; the only camera may have any name, and others have those of the import."""
    image = np.arange(768, dtype=np.uint8).reshape(2, 16, 8, 3)
    values = image.transpose(0, 3, 1, 2).astype(np.float32) / 255
    for names in (["image"], ["images.top"], ["images.top", "image"]):
        batch = {f"observation.{name}": values if name == names[-1] else 1 - values for name in names}
        seen = observations(batch | {"task": ["", ""]}, ["image"])
        np.testing.assert_array_equal(np.stack([each["image"] for each in seen]), image)
    batch = {"observation.image": values, "observation.images.hand_image": 1 - values}
    for seen, first in zip(observations(batch, ["image.hand", "image.image"]), image, strict=True):
        np.testing.assert_array_equal(seen["image.image"], first)
        np.testing.assert_array_equal(seen["image.hand"], 255 - first)


IMAGE = np.zeros((2, 3, 4, 5), np.float32)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images.b": None}, "observation.images.b: missing, expected an array: got .*state, observation.images.a$"),
        ({"state": None}, "observation.state: missing"),
        ({"state": np.zeros(3)}, r"observation.state: got shape \[3\], expected \[B, S\]"),
        ({"state": np.zeros((3, 3))}, "batch: got {.*'state': 3.*} environments, expected the same number"),
        ({"images.a": np.zeros((2, 4, 5, 3))}, r"images.a: got shape \[2, 4, 5, 3\], expected \[B, 3, H, W\]"),
        ({"images.a": IMAGE.astype(np.uint8)}, r"images.a: got uint8, expected real numbers in \[0, 1\]"),
        ({"images.a": IMAGE - 2}, r"images.a: got numbers from -2.0 to -2.0, expected numbers in \[0, 1\]"),
        ({"images.a": IMAGE + np.nan}, "images.a: got numbers from nan to nan"),
    ],
)
def test_what_is_missing_or_does_not_fit_is_named(changes, message):
    good = {"state": np.zeros((2, 3), np.float32), "images.a": IMAGE, "images.b": IMAGE}
    batch = {f"observation.{name}": value for name, value in (good | changes).items() if value is not None}
    with pytest.raises(ValueError, match=message):
        observations(batch, ["image.a", "image.b", "state"])


def test_the_only_camera_of_a_policy_must_be_the_only_one_there():
    with pytest.raises(
        ValueError, match=r"observation.image: missing, .*got observation.images.a, observation.images.b"
    ):
        observations({"observation.images.a": IMAGE, "observation.images.b": IMAGE}, ["image"])


def test_acting_needs_a_demonstration_and_the_same_environments(policy, demos):
    batched, seen = Batched(policy), [random_observation() for _ in range(2)]
    with pytest.raises(ValueError, match="demo: missing, expected a call of `reset` with one"):
        batched.act(batch_of(seen))
    batched.reset(demos[0])
    batched.act(batch_of(seen))
    with pytest.raises(ValueError, match="batch: got 1 environments, expected 2 until the next `reset`"):
        batched.act(batch_of(seen[:1]))
    wide = batch_of(seen) | {"observation.images.hand": np.zeros((2, 3, 8, 9), np.float32)}
    with pytest.raises(
        ValueError, match=r"environment 0: observation.image.hand: got shape \[8, 9, 3\], expected \[8, 8"
    ):
        batched.act(wide)
    bad = batch_of(seen) | {"observation.state": np.array([[0, 0, 0], [0, np.inf, 0]], np.float32)}
    with pytest.raises(ValueError, match=r"environment 1: observation.state: got inf at \(1,\)"):
        batched.act(bad)


def test_who_lacks_lerobot_is_told_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.delitem(sys.modules, "milx.deploy.lerobot", raising=False)
    with pytest.raises(ImportError, match="needs LeRobot and PyTorch: pip install 'lerobot>="):
        importlib.import_module("milx.deploy.lerobot")


class World(gymnasium.Env):
    """Shows noise to two cameras, and notes what it has shown and what was done."""

    metadata = {"render_fps": 10}  # noqa: RUF012
    cameras = {name: gymnasium.spaces.Box(0, 255, (*size, 3), np.uint8) for name, size in SIZES.items()}  # noqa: RUF012
    observation_space = gymnasium.spaces.Dict(
        {"pixels": gymnasium.spaces.Dict(cameras), "agent_pos": gymnasium.spaces.Box(-9, 9, (S,), np.float64)}
    )
    action_space = gymnasium.spaces.Box(-9, 9, (A,), np.float32)

    def __init__(self):
        self.episodes = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.np_random.uniform(-1, 1, S)
        self.episodes.append(([], []))
        return self.observe(), {}

    def step(self, action):
        self.episodes[-1][1].append(action.copy())
        self.state = 0.5 * self.state + 0.1 * action.sum()
        seen = self.observe()
        return seen, 1.0, False, False, {"is_success": bool(seen["pixels"]["scene"][0, 0, 0] > 127)}

    def observe(self):
        image = {name: self.np_random.integers(0, 256, (*size, 3), np.uint8) for name, size in SIZES.items()}
        self.episodes[-1][0].append(Observation(image, self.state.astype(np.float32)))
        return {"pixels": image, "agent_pos": self.state}


@pytest.fixture
def worlds():
    made = [gymnasium.wrappers.TimeLimit(World(), LENGTH) for _ in range(WORLDS)]
    mode = gymnasium.vector.AutoresetMode.SAME_STEP  # LeRobot's
    return gymnasium.vector.SyncVectorEnv([lambda world=world: world for world in made], autoreset_mode=mode)


def agree(policy, demo, worlds, batches):
    """Compares every action of every episode with milx's own acting on what was seen."""
    for batch in range(batches):
        # LeRobot resets for the next batch, and environments reset themselves when their episodes end.
        seen, done = zip(*(world.unwrapped.episodes[2 * batch] for world in worlds.envs), strict=True)
        assert {len(each) for each in done} == {LENGTH}
        episode = list(zip(*seen, strict=True))[:LENGTH]
        expected = acted(policy, demo, [list(each) for each in episode])
        np.testing.assert_allclose(np.stack(done, axis=1), expected, atol=1e-5)


@pytest.mark.lerobot
def test_lerobot_s_loop_does_what_milx_does(policy, demos, worlds):
    """Evaluates two batches of episodes, with LeRobot's own processors that change nothing."""
    from lerobot.processor import DeviceProcessorStep, PolicyProcessorPipeline
    from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action
    from lerobot.scripts.lerobot_eval import eval_policy

    from milx.deploy.lerobot import LeRobotPolicy

    before, after = PolicyProcessorPipeline([]), PolicyProcessorPipeline([])
    first = PolicyProcessorPipeline([DeviceProcessorStep("cpu")])
    last = PolicyProcessorPipeline(
        [DeviceProcessorStep("cpu")], to_transition=policy_action_to_transition, to_output=transition_to_policy_action
    )
    own = LeRobotPolicy(policy)
    with pytest.raises(ValueError, match="demo: missing, expected a call of `reset` with one"):
        eval_policy(worlds, own, before, after, first, last, n_episodes=1)
    for world in worlds.envs:
        world.unwrapped.episodes.clear()
    own.reset(demos[0])
    info = eval_policy(worlds, own, before, after, first, last, n_episodes=2 * WORLDS, start_seed=5)
    agree(policy, demos[0], worlds, batches=2)
    assert info["aggregated"]["avg_sum_reward"] == LENGTH
    episodes = [world.unwrapped.episodes[2 * batch] for batch in range(2) for world in worlds.envs]
    ends = [bool(seen[-1].image["scene"][0, 0, 0] > 127) for seen, _ in episodes]
    assert [each["success"] for each in info["per_episode"]] == ends
    assert len(set(ends)) == 2, "some episodes succeed"


@pytest.mark.lerobot
def test_the_example_of_the_how_to_runs(policy, demos, worlds, monkeypatch):
    (block,) = re.findall(r"^```py\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    monkeypatch.setattr(milx, "load", {"runs/demos": policy}.__getitem__)
    exec(compile(block, PAGE.name, "exec"), {"worlds": worlds, "demo": demos[1]})
    agree(policy, demos[1], worlds, batches=2)


@pytest.mark.lerobot
def test_what_a_policy_of_milx_cannot_do_for_lerobot_is_refused(policy, tmp_path):
    from milx.deploy.lerobot import LeRobotPolicy

    own = LeRobotPolicy(policy)
    for asks, message in (
        (lambda: own.forward({}), "python -m milx.train"),
        (own.get_optim_params, "python -m milx.train"),
        (lambda: own.predict_action_chunk({}), "call `select_action`"),
        (lambda: own.save_pretrained(tmp_path / "saved"), "python -m milx.export"),
    ):
        with pytest.raises(NotImplementedError, match=message):
            asks()
