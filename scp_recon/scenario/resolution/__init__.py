"""What is computed of a scenario, subject by subject."""
