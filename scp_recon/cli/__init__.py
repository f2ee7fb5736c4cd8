"""Shared by the commands: how they end, their options, verdicts, and what is kept of a run."""
