"""Whether a mission is hardly what was meant: units, axes, and entries that contradict each other."""
