"""Checks of a mission: units, axes, and entries that contradict each other."""
