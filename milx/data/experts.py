"""Which expert demonstrates, by a run's settings, and the plans with which an expert by sampling begins."""

import dataclasses
import functools
import hashlib
import json

import jax
import mujoco

from milx.config.schema import DataConfig
from milx.core import platform, pytrees
from milx.core.messages import warn
from milx.envs.base import Env
from milx.trajopt import expert
from milx.trajopt.expert import Sampling
from milx.trajopt.ilqr import Options
from milx.trajopt.planner import Plans, Settings, find_plans

EXPERTS = ("ilqr", "sampling")
SETTINGS = Settings()
"""Of experts by sampling."""


def expert_of(env: Env, config: DataConfig) -> Options | Sampling:
    """Returns the expert that a run's settings ask for.

    The first expert by sampling of an environment searches for plans with which others begin, under the same noise, and
    keeps them in the user's cache.

    Warns:
        if fewer than half of these plans succeed, or so few that a scene cannot try as many as it should.

    Raises:
        ValueError: for another name than those of EXPERTS, or sampling without an iteration.
    """
    if config.expert not in EXPERTS:
        raise ValueError(f"data.expert: got {config.expert!r}, expected one of {', '.join(EXPERTS)}")
    if config.expert == "ilqr":
        return Options(iterations=config.plan_iterations)
    if config.plan_iterations < 1:
        raise ValueError(f"data.plan_iterations: got {config.plan_iterations}, expected at least 1 with sampling")
    search = dataclasses.replace(SETTINGS.search, iterations=config.plan_iterations)
    plans = _plans(env, SETTINGS, config.noise)
    succeeded = int(plans.success.sum())
    if succeeded < max(SETTINGS.scenes / 2, min(SETTINGS.tried, SETTINGS.scenes)):
        warn(f"only {succeeded} of the {SETTINGS.scenes} plans succeed with which demonstrations of {env.name} begin")
    return Sampling(dataclasses.replace(SETTINGS, search=search), plans)


def description(config: DataConfig) -> list:
    """Lists what decides, beside versions, what an expert plans."""
    sampling = [] if config.expert == "ilqr" else [config.expert, repr(SETTINGS)]
    return [config.noise, config.plan_iterations, *sampling]


@functools.cache
def _plans(env: Env, settings: Settings, noise: float) -> Plans:
    request = [env.name, repr(settings), env.action_cost, noise, jax.default_backend()]
    request += [jax.__version__, mujoco.__version__, env.version, expert.VERSION]
    digest = hashlib.sha256(json.dumps(request).encode()).hexdigest()[:16]
    find = functools.partial(find_plans, env, settings, noise, jax.random.key(0))
    path = platform.cache_folder() / "plans" / f"{env.name}-{digest}.npz"
    return pytrees.kept(path, find, lambda: jax.eval_shape(find))
