"""Configurations: their fields, the values that the fields may have, and the presets."""
