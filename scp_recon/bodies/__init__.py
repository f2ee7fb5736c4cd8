"""Data of asteroids: the packaged catalogue, surfaces, shapes, gravity fields, attitudes, kernels.

`catalogue` has the packaged bodies; `files` and `kernels` read what a scenario names. Scenarios,
physics and everything above them may import this folder, which imports `errors` and `files` of the
package alone.
"""
