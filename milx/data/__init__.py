"""Demonstrations: simulated ones, and their batches."""
