"""Policies for users and robots."""
