"""Simulate the spacecraft that flies a plan: vehicle, guidance, estimation, and the record."""
