"""Draw the polytopes that approximate the shell of the site distance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from scipy.spatial import ConvexHull, HalfspaceIntersection

from formulations.arrays import Array
from formulations.problem.facets import inner_facets, outer_facets
from formulations.problem.polytopes import paper_ball
from formulations.problem.regions import Ball, Halfspaces
from paper_figs.drawing import legend, page
from paper_figs.inputs import Flown, Runs
from paper_figs.paper.cone_polytopes import binding_node, most_probable, spacecraft
from scp_recon.physics import geometry


@dataclass(frozen=True)
class Sphere:
    """What surrounds the site at one node, seen from it.

    Attributes:
        time_s: of the node.
        point_m: the spacecraft, along the columns of `frame`, shape (3,); the first points to it.
        covariance_m2: of its position, along the same, shape (3, 3).
        frame: line of sight, the direction across it of the largest spread, and the third, as columns,
            J2000, shape (3, 3).
    """

    time_s: float
    point_m: Array
    covariance_m2: Array
    frame: Array


def sphere(flown: Flown) -> Sphere:
    """The node where the largest site distance is closest to binding."""
    mission, nodes = flown.mission, flown.solution.nodes
    node = binding_node(flown, "site_distance_max")
    site = geometry.track(mission.site, mission.rotation, mission.times_s[[node]]).position[0]
    line = np.array(nodes.state[node][:3]) - site
    covariance = np.array(nodes.covariance[node])[:3, :3]
    sight = line / np.linalg.norm(line)
    across = np.eye(3) - np.outer(sight, sight)
    widest = np.linalg.eigh(across @ covariance @ across)[1][:, -1]
    frame = np.stack([sight, widest, np.cross(sight, widest)], axis=1)
    turned = frame.T @ covariance @ frame
    return Sphere(float(mission.times_s[node]), frame.T @ line, turned, frame)


def facets(runs: Runs, seen: Sphere, radius_m: float, keep: str) -> Halfspaces:
    """Facets inside a ball about the site or around it, turned to the spacecraft, in the frame.

    They are the paper's where the plan has tangent planes alone.
    """
    place = inner_facets if keep == "in" else outer_facets
    ball = Ball(np.zeros((1, 3)), radius_m)
    own = runs.plan.mission.polytopes
    polytopes = own if own.ball else replace(own, ball=paper_ball())
    planes = place(ball, polytopes, (seen.frame @ seen.point_m)[None])
    normals = np.concatenate([plane.normal for plane in planes]) @ seen.frame
    return Halfspaces(normals, np.concatenate([plane.offset for plane in planes]))


def corners(planes: Halfspaces) -> Array:
    """Corners of a polytope around the site, shape (n, its dimensions)."""
    equations = np.column_stack([planes.normal, -planes.offset])
    inside = np.zeros(planes.normal.shape[1])
    found = HalfspaceIntersection(equations, inside).intersections
    _, first = np.unique(found.round(3), axis=0, return_index=True)
    return found[np.sort(first)]


def polygon(planes: Halfspaces) -> Array:
    """Section of a polytope with the plane of sight and largest spread, in order, shape (n, 2)."""
    found = corners(Halfspaces(planes.normal[:, :2], planes.offset))
    return found[np.argsort(np.arctan2(found[:, 1], found[:, 0]))]


def draw(runs: Runs) -> Figure:
    """Keep-in on the left and keep-out on the right, in the section above and in space below."""
    seen, limits = sphere(runs.plan), runs.plan.mission.scenario.observation
    low, high = limits.site_distance_min_m, limits.site_distance_max_m
    inner, outer = facets(runs, seen, high, "in"), facets(runs, seen, low, "out")
    chosen = most_probable(outer.normal, outer.offset, seen.point_m, seen.covariance_m2)
    with page(6.6) as figure:
        grid = figure.add_gridspec(2, 2, height_ratios=(1.35, 1.0))
        left, right = (figure.add_subplot(grid[0, column]) for column in range(2))
        count = len(inner.offset)
        left.add_patch(
            Polygon(
                polygon(inner), facecolor="0.88", edgecolor="k", lw=1.4,
                label=f"inside, {count} facets: all have to hold",
            )
        )  # fmt: skip
        left.set_title(f"keep in: site distance at most {high:g} m")
        _chosen(right, outer, chosen)
        right.add_patch(
            Polygon(
                polygon(outer),
                fill=False,
                edgecolor="0.6",
                lw=1.4,
                label=f"outside, {count} facets",
            )
        )
        right.set_title(f"keep out: site distance at least {low:g} m")
        for axes, radius in ((left, high), (right, low)):
            axes.add_patch(
                Circle((0, 0), radius, fill=False, lw=1.0, edgecolor="0.45", label="sphere")
            )
            spacecraft(axes, seen.point_m[:2], seen.covariance_m2[:2, :2])
            axes.plot(0.0, 0.0, "k^", ms=5, label="site")
            axes.set(
                xlabel="to the spacecraft (m)", ylabel="across (m)", aspect="equal",
                xlim=(-1.08 * high, 1.08 * high), ylim=(-1.08 * high, 1.08 * high),
            )  # fmt: skip
            axes.set_axisbelow(True)
        for column, (planes, radius, one) in enumerate(((inner, high, None), (outer, low, chosen))):
            space = figure.add_subplot(grid[1, column], projection="3d")
            _in_space(space, seen, planes, radius, one, high)
        legend(figure, 3, "outside lower center")
    return figure


def _chosen(axes: Axes, planes: Halfspaces, chosen: int) -> None:
    """The half-plane beyond a facet, and the facet's line, in the section."""
    across, offset = planes.normal[chosen, :2], planes.offset[chosen]
    length = float(np.linalg.norm(across))
    normal, foot, far = across / length, across * offset / length**2, 1e4
    along = far * np.array([-normal[1], normal[0]])
    line = np.stack([foot - along, foot + along])
    beyond = np.vstack([line, line[::-1] + far * normal])
    axes.add_patch(
        Polygon(beyond, facecolor="0.88", edgecolor="none", label="allowed by the facet chosen")
    )
    axes.plot(*line.T, "k-", lw=1.8, label="facet chosen: it has to hold")


def _in_space(
    axes: Any, seen: Sphere, planes: Halfspaces, radius_m: float, chosen: int | None, reach_m: float
) -> None:
    """Sphere and polytope, its corners marked, the chosen facet filled."""
    axes.computed_zorder = False  # what is drawn later lies above
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, 25), np.linspace(0, 2 * np.pi, 49))
    ball = radius_m * np.array(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
    )
    axes.plot_surface(*ball, color="0.75", alpha=0.25, linewidth=0, shade=False)
    points = corners(planes)
    triangles = ConvexHull(points).simplices
    axes.plot_trisurf(
        *points.T, triangles=triangles, color=(1, 1, 1, 0.12), edgecolor="0.25",
        linewidth=0.8, shade=False,
    )  # fmt: skip
    if chosen is not None:
        on = np.abs(points @ planes.normal[chosen] - planes.offset[chosen]) < 1e-6 * radius_m
        mine = triangles[on[triangles].all(axis=1)]
        axes.plot_trisurf(*points.T, triangles=mine, color="0.3", edgecolor="k", shade=False)
    axes.plot(*points.T, "o", color="0.25", ms=2.5)
    axes.plot(*([0.0, x] for x in seen.point_m), color="k", lw=1.0, ls=":")
    axes.plot(*([x] for x in seen.point_m), "ko", ms=4)
    axes.set_axis_off()
    reach = (-reach_m, reach_m)
    axes.set(xlim=reach, ylim=reach, zlim=reach)
    axes.set_aspect("equal")
    axes.set_box_aspect(axes.get_box_aspect(), zoom=1.45)
    axes.view_init(elev=18.0, azim=-38.0)
    side = "inside" if chosen is None else "outside"
    axes.set_title(f"{side}: {len(points)} corners, {len(planes.offset)} facets", y=1.0)


def caption(runs: Runs) -> str:
    """Describe the figure."""
    seen, limits = sphere(runs.plan), runs.plan.mission.scenario.observation
    inner = facets(runs, seen, limits.site_distance_max_m, "in")
    return (
        "Polytopic approximation of the two spheres of the site distance about "
        f"{runs.plan.mission.scenario.site.name}, at {seen.time_s:.0f} s, where the larger distance "
        "is closest to binding. Above: section through the site, the spacecraft and the direction "
        "across the line of sight in which its position spreads most, with the ellipses of one "
        f"(solid) and two (dotted) standard deviations. Left: all {len(inner.offset)} facets of the "
        f"polytope inside the sphere of {limits.site_distance_max_m:g} m have to hold; a corner of it "
        f"points to the spacecraft. Right: around the sphere of {limits.site_distance_min_m:g} m one "
        "facet has to hold, the one with the largest probability (black); the others (grey) are not "
        "used. Below: the same in space, the line of sight dotted. The polytopes are turned to the "
        "plan's own line of sight here; P2 uses those turned to P3's."
    )
