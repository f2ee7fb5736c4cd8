"""Plan a mission: make initial guesses, and run stages by SCP or IPOPT from one or several starts."""
