"""Design whole passes: choose burn times, on a home orbit phases and epochs too, for the least delta-v."""
