"""Presets of grasp, whose demonstrations are planned with a receding horizon on an accelerator."""

from milx.config.registry import Overrides
from milx.envs.place.presets import PLACE

_WORLD: Overrides = {
    "data.tasks": 1000,
    "data.demos_per_task": 2,
    "data.noise": 0.1,
    "data.spare_demos": 1,
    "data.expert": "receding",
    "data.plan_iterations": 1,
    "data.plan_batch": 512,
    "evaluation.tasks": 120,
    "evaluation.trials": 6,
    "evaluation.baseline_trials": 1,
    "evaluation.batch": 60,
}

GRASP: dict[str, Overrides] = {name: PLACE[name] | _WORLD for name in ("paper", "fast")}
