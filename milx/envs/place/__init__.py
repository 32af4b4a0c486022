"""Putting an object into a container."""
