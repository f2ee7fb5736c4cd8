"""Independent solutions of the same problems, that tests compare with the planner's."""
