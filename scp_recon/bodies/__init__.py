"""Data of asteroids: the packaged catalogue, surfaces, shape files, kernels, gravity fields.

`catalogue` has the packaged bodies; the other modules each read one kind of file. Scenarios, physics
and everything above them may import this folder; it imports `errors` and `files` alone.
"""
