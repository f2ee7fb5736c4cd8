"""Design whole passes from a home orbit: choose phases, epochs and burn times for the least delta-v."""
