"""Compute forces, frames, geometry, and the flow of states with its derivatives."""
