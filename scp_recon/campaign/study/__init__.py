"""What a study asks: its base, its axes, and the cases that they make."""
