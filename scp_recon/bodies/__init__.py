"""Data of asteroids: the packaged catalogue, surfaces, shape files, kernels, gravity fields."""
