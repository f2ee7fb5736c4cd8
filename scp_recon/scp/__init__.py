"""Sequential convex programming: the loop, and the algorithms that globalise it."""
