"""The planner beside other tools, on problems that they can state."""
