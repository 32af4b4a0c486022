"""Pushing an object to a goal."""
