"""The flyby problem as data: arcs, regions, and the polytopes and facets that stand for them."""
