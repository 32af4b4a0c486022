"""Demonstrations: simulated and recorded ones, and their batches."""

from milx.config.registry import register_presets
from milx.data.presets import RECORDED_PRESETS

RECORDED = "recorded"
"""What `Config.env_name` is where a run has recorded demonstrations instead of an environment."""

register_presets(RECORDED, RECORDED_PRESETS)
