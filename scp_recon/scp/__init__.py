"""Run sequential convex programming: the loop, its algorithms, and their statuses."""
