"""Replan a flight under way: check the delivered state, and set up the rest of the flight."""
