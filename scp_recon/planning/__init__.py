"""From a mission to a plan: guesses, stages, and who solves them."""
