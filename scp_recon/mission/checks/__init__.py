"""Check a mission's units, axes, and entries that contradict each other."""
