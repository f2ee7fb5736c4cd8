"""Design whole passes from a home orbit: phases, epochs and burn times, in a loop around plans."""
