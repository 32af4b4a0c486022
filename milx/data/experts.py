"""Which expert demonstrates, by a run's settings, and what some experts find before they demonstrate."""

import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import pathlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import mujoco
from rich.console import Console

from milx.config.schema import DataConfig
from milx.core import platform, progress, pytrees
from milx.core.messages import warn
from milx.envs.base import Env
from milx.trajopt import expert, learned, receding
from milx.trajopt.demonstrations import find_plans, no_plans, share_plans
from milx.trajopt.expert import Expert, Learned, Planned, Receding, Sampling
from milx.trajopt.ilqr import Options
from milx.trajopt.planner import Plans, Settings

SETTINGS = Settings()
"""Of experts that plan whole episodes by sampling."""
RECEDING = receding.Settings()
"""Of experts with a receding horizon."""
LEARNED = learned.Settings()
"""Of experts that learn by policy optimization."""
PRETRAINED = pathlib.Path(__file__).parent / "actors"
"""Folder of the experts by policy optimization that ship, one file for an environment."""


def expert_of(env: Env, config: DataConfig) -> Expert:
    """Returns the expert that a run's settings ask for.

    The first expert that plans whole episodes of an environment by sampling searches for plans with which others begin,
    under the same noise, lets these scenes begin again with each other's plans, in rounds, and keeps the plans in the
    user's cache.

    It says so if fewer than half of these plans succeed. The first expert by policy optimization learns, under the same
    noise, and is kept there, too. The process in which it learns says so if it costs no less than at the beginning.

    Raises:
        ValueError: for another name than those of EXPERTS, no iterations of one that needs them, or an environment
            that an expert does not know.
        FileError: if the file of an expert that ships cannot be read, or is of other types or sizes, as under x64.
    """
    return _kind(config).make(env, config)


def description(env: Env, config: DataConfig) -> list:
    """Lists what decides, beside versions, what an expert plans.

    Raises:
        ValueError, FileError: as `expert_of`.
    """
    return [config.noise, *_kind(config).describe(env, config)]


class Kind(NamedTuple):
    """A kind of experts.

    Attributes:
        make: makes one for an environment.
        describe: lists what decides what it plans, beside versions and the noise.
        plans: whether it needs `data.plan_iterations`.
    """

    make: Callable[[Env, DataConfig], Expert]
    describe: Callable[[Env, DataConfig], list]
    plans: bool = True


def _kind(config: DataConfig) -> Kind:
    """Looks up who is to demonstrate."""
    if config.expert not in EXPERTS:
        instead = "; push has 'pretrained' now, with which an earlier run can be evaluated, but not go on"
        instead = instead if config.expert == "controller" else ""
        raise ValueError(f"data.expert: got {config.expert!r}, expected one of {', '.join(EXPERTS)}{instead}")
    kind = EXPERTS[config.expert]
    if kind.plans and config.plan_iterations < 1:
        raise ValueError(
            f"data.plan_iterations: got {config.plan_iterations}, expected at least 1 with {config.expert}"
        )
    return kind


def _planned(_: Env, config: DataConfig) -> Expert:
    return Planned(Options(iterations=config.plan_iterations))


def _sampling(env: Env, config: DataConfig) -> Expert:
    search = dataclasses.replace(SETTINGS.search, iterations=config.plan_iterations)
    return Sampling(
        dataclasses.replace(SETTINGS, search=search), _plans(env, SETTINGS, config.noise, config.plan_batch)
    )


def _receding(_: Env, config: DataConfig) -> Expert:
    search = dataclasses.replace(RECEDING.search, iterations=config.plan_iterations)
    return Receding(dataclasses.replace(RECEDING, search=search))


def _ppo(env: Env, config: DataConfig) -> Expert:
    settings = dataclasses.replace(LEARNED, iterations=config.plan_iterations)
    return Learned(settings, _actor(env, settings, config.noise))


def _pretrained(env: Env, _: DataConfig) -> Expert:
    return Learned(LEARNED, _shipped(env))


def digest(env: Env, *request: Any) -> str:
    """Hashes what was asked of an expert, and all versions that what it plans depends on."""
    versions = [jax.default_backend(), jax.__version__, mujoco.__version__, env.version, expert.VERSION]
    if env.physics == "warp":
        versions.append(f"warp {importlib.metadata.version('warp-lang')}")
    return hashlib.sha256(json.dumps([env.name, *request, env.action_cost, *versions]).encode()).hexdigest()[:16]


@functools.cache
def _shipped(env: Env) -> learned.Actor:
    path = PRETRAINED / f"{env.name}.npz"
    if not path.exists():
        there = ", ".join(sorted(path.stem for path in PRETRAINED.glob("*.npz")))
        raise ValueError(
            f"data.expert: got 'pretrained', expected another one with {env.name}: experts ship for {there} only"
        )
    return pytrees.read(path, learned.shapes(env, LEARNED))


@functools.cache
def _actor(env: Env, settings: learned.Settings, noise: float) -> learned.Actor:
    path = platform.cache_folder() / "actors" / f"{env.name}-{digest(env, repr(settings), noise)}.npz"

    def make() -> learned.Actor:
        with progress.phase(Console(), f"learning to demonstrate {env.name}", settings.iterations):
            actor, costs = learned.learn(env, settings, noise, jax.random.key(0))
        if len(costs) > 1 and not costs[-1] < costs[0]:
            warn(
                f"the expert of {env.name} has learned nothing: an episode costs {costs[-1]:.3g} at the end, and cost "
                f"{costs[0]:.3g} at the beginning; its costs, its steering or data.noise may be why"
            )
        return actor

    return pytrees.kept(path, make, lambda: learned.shapes(env, settings))


@functools.cache
def _plans(env: Env, settings: Settings, noise: float, batch: int) -> Plans:
    key = jax.random.key(0)
    path = platform.cache_folder() / "plans" / f"{env.name}-{digest(env, repr(settings), noise)}.npz"

    def make() -> Plans:
        return share_plans(env, settings, find_plans(env, settings, noise, key, batch), noise, key, batch)

    plans = pytrees.kept(path, make, lambda: jax.eval_shape(lambda: no_plans(env, settings, key)))
    if (succeeded := int(plans.success.sum())) < settings.scenes / 2:
        begin = f"of the {settings.scenes} plans with which demonstrations of {env.name} begin"
        warn(
            f"only {succeeded} {begin} succeed, expected half of them; its costs, its steering or data.noise may be why"
        )
    return plans


EXPERTS: dict[str, Kind] = {
    "ilqr": Kind(_planned, lambda _, config: [config.plan_iterations]),
    "sampling": Kind(_sampling, lambda _, config: [config.plan_iterations, "sampling", repr(SETTINGS)]),
    "receding": Kind(_receding, lambda env, config: [config.plan_iterations, "receding", repr(RECEDING), env.ahead]),
    "ppo": Kind(_ppo, lambda _, config: [config.plan_iterations, "ppo", repr(LEARNED)]),
    "pretrained": Kind(_pretrained, lambda env, _: ["pretrained", pytrees.fingerprint(_shipped(env))], plans=False),
}
"""By name, as in `data.expert`. Another entry is another expert."""
