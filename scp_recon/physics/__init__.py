"""Compute forces, frames, geometry, and the flow of states with its derivatives.

`forces` has the one set of equations of motion, `flow` integrates it. Missions and everything above
them may import this folder; it imports `scenario`, `bodies` and `formulations`.
"""
