"""Simulate the spacecraft that flies a plan: vehicle, guidance, estimation, and the record.

Plain NumPy, without Basilisk: only `basilisk` inside it needs the extra [sim]. Verification and
everything above it may import this folder; it imports `monte_carlo` and below.
"""
