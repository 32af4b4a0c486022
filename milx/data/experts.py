"""Which expert demonstrates, by a run's settings, and what some experts find before they demonstrate."""

import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import pathlib
from typing import Any

import jax
import mujoco
from rich.console import Console

from milx.config.schema import DataConfig
from milx.core import platform, progress, pytrees
from milx.core.messages import warn
from milx.envs.base import Env
from milx.trajopt import expert, learned, receding
from milx.trajopt.demonstrations import find_plans, no_plans, share_plans
from milx.trajopt.expert import Expert, Learned, Sampling
from milx.trajopt.ilqr import Options
from milx.trajopt.planner import Plans, Settings

EXPERTS = ("ilqr", "sampling", "receding", "ppo", "pretrained")
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
    noise, and is kept there, too. It says so if it costs no less than at the beginning.

    Raises:
        ValueError: for another name than those of EXPERTS, no iterations of one that needs them, or an environment
            for which no expert ships.
    """
    _check(env, config)
    if config.expert == "ilqr":
        return Options(iterations=config.plan_iterations)
    if config.expert == "receding":
        search = dataclasses.replace(RECEDING.search, iterations=config.plan_iterations)
        return dataclasses.replace(RECEDING, search=search)
    if config.expert == "ppo":
        settings = dataclasses.replace(LEARNED, iterations=config.plan_iterations)
        return Learned(settings, _actor(env, settings, config.noise))
    if config.expert == "pretrained":
        return Learned(LEARNED, _pretrained(env))
    search = dataclasses.replace(SETTINGS.search, iterations=config.plan_iterations)
    return Sampling(
        dataclasses.replace(SETTINGS, search=search), _plans(env, SETTINGS, config.noise, config.plan_batch)
    )


def description(env: Env, config: DataConfig) -> list:
    """Lists what decides, beside versions, what an expert plans.

    Raises:
        ValueError: as `expert_of`.
    """
    _check(env, config)
    settings: dict[str, list] = {
        "ilqr": [],
        "sampling": ["sampling", repr(SETTINGS)],
        "receding": ["receding", repr(RECEDING), env.ahead],
        "ppo": ["ppo", repr(LEARNED)],
    }
    if config.expert == "pretrained":
        return [config.noise, "pretrained", pytrees.fingerprint(_pretrained(env))]
    return [config.noise, config.plan_iterations, *settings[config.expert]]


def _check(env: Env, config: DataConfig) -> None:
    """Refuses what `expert_of` documents."""
    if config.expert not in EXPERTS:
        raise ValueError(f"data.expert: got {config.expert!r}, expected one of {', '.join(EXPERTS)}")
    if config.expert not in ("ilqr", "pretrained") and config.plan_iterations < 1:
        raise ValueError(
            f"data.plan_iterations: got {config.plan_iterations}, expected at least 1 with {config.expert}"
        )
    if config.expert == "pretrained" and not (PRETRAINED / f"{env.name}.npz").exists():
        there = ", ".join(sorted(path.stem for path in PRETRAINED.glob("*.npz")))
        raise ValueError(
            f"data.expert: got 'pretrained', expected another one with {env.name}: experts ship for {there} only"
        )


def digest(env: Env, *request: Any) -> str:
    """Hashes what was asked of an expert, and all versions that what it plans depends on."""
    versions = [jax.default_backend(), jax.__version__, mujoco.__version__, env.version, expert.VERSION]
    if env.physics == "warp":
        versions.append(f"warp {importlib.metadata.version('warp-lang')}")
    return hashlib.sha256(json.dumps([env.name, *request, env.action_cost, *versions]).encode()).hexdigest()[:16]


@functools.cache
def _pretrained(env: Env) -> learned.Actor:
    return pytrees.read(PRETRAINED / f"{env.name}.npz", learned.shapes(env, LEARNED))


@functools.cache
def _actor(env: Env, settings: learned.Settings, noise: float) -> learned.Actor:
    path = platform.cache_folder() / "actors" / f"{env.name}-{digest(env, repr(settings), noise)}.npz"

    def make() -> learned.Actor:
        with progress.phase(Console(), f"learning to demonstrate {env.name}", settings.iterations):
            actor, costs = learned.learn(env, settings, noise, jax.random.key(0))
        if not costs[-1] < costs[0]:
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
