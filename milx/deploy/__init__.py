"""Trained policies: loading them, using them, and exporting them for robots."""
