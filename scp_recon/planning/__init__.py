"""Plan a mission: initial guesses, stages, SCP, IPOPT, several starts."""
