"""The flyby problem as data: arcs, regions, execution errors, polytopes and facets.

`flyby` is the problem and its iterates, `flow` the interface of the motion, `regions` and `facets`
bound the position. Everything may import this folder; it imports `risk` and `arrays`.
"""
