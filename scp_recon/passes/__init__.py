"""Design whole passes for the least delta-v: burn times, and on a home orbit phases and epochs."""
