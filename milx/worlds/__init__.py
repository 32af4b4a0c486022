"""Worlds that are not milx's: any Gymnasium environment, in processes of its own, in which policies are evaluated."""

from milx.worlds.actor import CONTROLS
from milx.worlds.client import WorldError
from milx.worlds.evaluate import evaluate_in, tasks_of
from milx.worlds.report import summarize
from milx.worlds.slot import Episode, Outcome, Task

__all__ = ["CONTROLS", "Episode", "Outcome", "Task", "WorldError", "evaluate_in", "summarize", "tasks_of"]
