"""What a solution says, checked without the solver."""
