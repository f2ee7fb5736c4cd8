"""From a mission to a plan: initial guesses, stages, SCP, IPOPT, several starts."""
