"""The flyby problem as data: arcs, regions, execution errors, polytopes and facets."""
