"""Trajectory optimization: the planner that demonstrates the tasks."""
