"""Asteroid reconnaissance flybys planned under uncertainty by sequential convex programming."""
