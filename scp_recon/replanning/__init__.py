"""Replanning a flight that is under way: what was delivered, what is left, and the plan of it."""
