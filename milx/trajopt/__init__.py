"""Trajectory optimisation: the planner that demonstrates the tasks."""
