"""Configurations: what they hold, which values they may have, and the presets."""
