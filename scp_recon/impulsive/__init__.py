"""Plan and fly impulsive transfers of any flow, stated by arrays instead of a scenario."""
