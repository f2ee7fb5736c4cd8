"""Sequential convex programming: the loop, its globalisations, and how it ends."""
