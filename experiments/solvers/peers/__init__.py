"""Compare the planner with other tools on problems that they can state."""
