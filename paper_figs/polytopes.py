"""Draw the polytopes that approximate the spheres of the site distance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from scipy.spatial import HalfspaceIntersection

from formulations.arrays import Array
from formulations.problem.facets import inner_facets, outer_facets, paper_ball
from formulations.problem.regions import Ball, Halfspaces
from paper_figs.drawing import Look
from paper_figs.inputs import Runs
from scp_recon.physics import geometry
from scp_recon.results.pictures import legend, page

TURN = np.linspace(0.0, 2.0 * np.pi, 181)
FAR = 10.0
"""Length of the half-plane that a facet allows, over its distance."""


def ball_polytopes(runs: Runs) -> Figure:
    """Keep-in on the left and keep-out on the right, in the plane of the widest spread.

    Where the upper limit is closest to binding; with exact risk that is the joint constraint's node.
    Polytopes are the paper's where the plan has tangent planes alone.
    """
    solution, mission = runs.plan.solution, runs.plan.solution.mission
    names = "site_distance_max", "site_distance"
    worst = next(c.worst_t_s for c in solution.constraints if c.name in names)
    node = int(np.argmin(np.abs(mission.times_s - worst)))
    site = geometry.track(mission.site, mission.rotation, mission.times_s[[node]]).position[0]
    line = np.array(solution.nodes.state[node])[:3] - site
    covariance = np.array(solution.nodes.covariance[node])[:3, :3]
    sight = line / np.linalg.norm(line)
    across = np.eye(3) - np.outer(sight, sight)
    widest = np.linalg.eigh(across @ covariance @ across)[1][:, -1]
    frame = np.stack([sight, widest, np.cross(sight, widest)], axis=1)
    own, limits = mission.polytopes, mission.scenario.observation
    polytopes = own if own.ball else replace(own, ball=paper_ball())
    least, most = limits.site_distance_min_m, limits.site_distance_max_m
    point, spread = frame.T @ line, frame.T @ covariance @ frame
    with page(4.0) as figure:
        panels = figure.subplots(1, 2, subplot_kw={"aspect": "equal"})
        for axes, place, radius in zip(
            panels, (inner_facets, outer_facets), (most, least), strict=True
        ):
            planes = place(Ball(site[None], radius), polytopes, (site + line)[None])
            normal = np.concatenate([plane.normal for plane in planes])
            offset = np.concatenate([plane.offset for plane in planes]) - normal @ site
            section = Halfspaces(normal @ frame, offset)
            if radius == most:
                _keep_in(axes, section)
            else:
                _keep_out(axes, section, point, spread)
            circle = radius * np.stack([np.cos(TURN), np.sin(TURN)])
            axes.plot(*circle, "C0--", lw=1.2, label="sphere of the limit")
            _spread(axes, point, spread)
            axes.plot(0.0, 0.0, "k^", ms=5, label="site")
            words = "in: at most" if radius == most else "out: at least"
            axes.set_title(f"keep {words} {radius:g} m from the site")
            reach = 1.08 * most * np.array([-1.0, 1.0])
            axes.set(xlabel="to the spacecraft (m)", ylabel="across (m)", xlim=reach, ylim=reach)
        legend(figure, 3, "outside lower center")
    return figure


def _section(planes: Halfspaces) -> Array:
    """Section of a polytope around the origin, its corners in order about it, shape (n, 2)."""
    equations = np.column_stack([planes.normal[:, :2], -planes.offset])
    found = HalfspaceIntersection(equations, np.zeros(2)).intersections
    _, first = np.unique(found.round(3), axis=0, return_index=True)
    found = found[np.sort(first)]
    return found[np.argsort(np.arctan2(found[:, 1], found[:, 0]))]


def _keep_in(axes: Axes, planes: Halfspaces) -> None:
    """Draw the polytope inside: all facets must hold."""
    label = f"inside, {len(planes.offset)} facets: all have to hold"
    look: Look = {"facecolor": "0.88", "edgecolor": "k", "lw": 1.4}
    axes.add_patch(Polygon(_section(planes), label=label, **look))


def _keep_out(axes: Axes, planes: Halfspaces, point: Array, covariance: Array) -> None:
    """Draw the polytope outside and the half-plane beyond its most probable facet, which must hold."""
    spread = np.einsum("mi,ij,mj->m", planes.normal, covariance, planes.normal)
    chosen = int(np.argmax((planes.normal @ point - planes.offset) / np.sqrt(spread)))
    normal, offset = planes.normal[chosen, :2], planes.offset[chosen]
    foot = normal * offset / (normal @ normal)
    along = FAR * np.array([-foot[1], foot[0]])
    line = np.stack([foot - along, foot + along])
    look: Look = {"facecolor": "0.88", "edgecolor": "none"}
    beyond = np.vstack([line, line[::-1] + FAR * foot])
    axes.add_patch(Polygon(beyond, label="allowed by the facet chosen", **look))
    axes.plot(*line.T, "k-", lw=1.8, label="facet chosen: it has to hold")
    ring = _section(planes)
    label = f"outside, {len(planes.offset)} facets: one has to hold"
    axes.plot(*np.vstack([ring, ring[:1]]).T, color="C2", lw=1.4, label=label)


def _spread(axes: Axes, point: Array, covariance: Array) -> None:
    """The spacecraft with one and two standard deviations."""
    factor = np.linalg.cholesky(covariance[:2, :2])
    for sigmas, dashes in ((1.0, "-"), (2.0, ":")):
        ellipse = point[:2, None] + sigmas * factor @ np.stack([np.cos(TURN), np.sin(TURN)])
        axes.plot(*ellipse, color="C1", ls=dashes, lw=1.2, label=f"{sigmas:g} sigma")
    axes.plot(*point[:2], "o", color="C1", ms=4, label="spacecraft")
