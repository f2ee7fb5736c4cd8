"""Draw the polytopes that approximate the emission cones and the spheres of the site distance."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from scipy.spatial import HalfspaceIntersection

from formulations.arrays import Array
from formulations.problem.facets import Polytopes, inner_facets, outer_facets, paper_ball
from formulations.problem.regions import Ball, Cone, Halfspaces
from paper_figs.drawing import Look
from paper_figs.inputs import FlownPlan, Runs
from scp_recon.physics import geometry
from scp_recon.results.pictures import legend, page

MANY = 12
"""Facets of the pyramids drawn beside those of the scenario."""
TURN = np.linspace(0.0, 2.0 * np.pi, 181)


@dataclass(frozen=True)
class Section:
    """A plane through the spacecraft at one node, in which a region is a disc about the origin.

    Attributes:
        origin_m: J2000, shape (3,).
        frame: the plane's axes and its normal as columns, J2000, shape (3, 3).
        point_m: the spacecraft from the origin along the frame, whose first axis points to it, (3,).
        covariance_m2: of its position along the frame, shape (3, 3).
    """

    origin_m: Array
    frame: Array
    point_m: Array
    covariance_m2: Array

    def facets(self, region: Ball | Cone, polytopes: Polytopes, keep: str) -> Halfspaces:
        """Facets inside a region or around it, turned to the spacecraft, along the frame."""
        place = inner_facets if keep == "in" else outer_facets
        planes = place(region, polytopes, (self.origin_m + self.frame @ self.point_m)[None])
        normal = np.concatenate([plane.normal for plane in planes])
        offset = np.concatenate([plane.offset for plane in planes]) - normal @ self.origin_m
        return Halfspaces(normal @ self.frame, offset)

    def most_probable(self, planes: Halfspaces) -> int:
        """The facet beyond which the spacecraft is with the largest probability."""
        beyond = planes.normal @ self.point_m - planes.offset
        spread = np.einsum("mi,ij,mj->m", planes.normal, self.covariance_m2, planes.normal)
        return int(np.argmax(beyond / np.sqrt(spread)))


def _at(flown: FlownPlan, name: str) -> tuple[Array, Array, Array, Array]:
    """Site, its normal, line of sight and covariance where a constraint is closest to binding.

    With exact risk it is the joint constraint's node.
    """
    mission, nodes = flown.mission, flown.solution.nodes
    worst = (c.worst_t_s for c in flown.solution.constraints if name.startswith(c.name))
    node = int(np.argmin(np.abs(mission.times_s - next(worst))))
    track = geometry.track(mission.site, mission.rotation, mission.times_s[[node]])
    site, covariance = track.position[0], np.array(nodes.covariance[node])[:3, :3]
    return site, track.normal[0], np.array(nodes.state[node][:3]) - site, covariance


def polygon(planes: Halfspaces) -> Array:
    """Section of a polytope around the origin, its corners in order about it, shape (n, 2)."""
    equations = np.column_stack([planes.normal[:, :2], -planes.offset])
    found = HalfspaceIntersection(equations, np.zeros(2)).intersections
    _, first = np.unique(found.round(3), axis=0, return_index=True)
    found = found[np.sort(first)]
    return found[np.argsort(np.arctan2(found[:, 1], found[:, 0]))]


def cone_polytopes(runs: Runs) -> Figure:
    """Keep-in on the left and keep-out on the right, in a section across the normal and in space."""
    site, normal, line, covariance = _at(runs.plan, "emission_max")
    height = float(line @ normal)
    across = line - height * normal
    first = across / np.linalg.norm(across)
    frame = np.stack([first, np.cross(normal, first), normal], axis=1)
    origin = site + height * normal
    cut = Section(origin, frame, frame.T @ across, frame.T @ covariance @ frame)
    limits, count = runs.plan.mission.scenario.observation, runs.plan.mission.polytopes.cone_facets
    low, high = limits.emission_min_deg, limits.emission_max_deg

    def pyramid(angle_deg: float, many: int, keep: str) -> Halfspaces:
        cone = Cone(site[None], normal[None], float(np.deg2rad(angle_deg)))
        return cut.facets(cone, Polytopes(None, many), keep)

    inner, outer = pyramid(high, count, "in"), pyramid(low, count, "out")
    near, far = (height * float(np.tan(np.deg2rad(angle))) for angle in (low, high))
    with page(6.3) as figure:
        left, right, *spaces = _panels(figure, 1.5)
        _keep_in(left, cut, inner, "cone", far)
        more: Look = {"fill": False, "edgecolor": "k", "ls": "--", "lw": 0.9}
        around = polygon(pyramid(high, MANY, "in"))
        left.add_patch(Polygon(around, label=f"inside, {MANY} facets", **more))
        _keep_out(right, cut, outer, "cone", near)
        left.set(title=f"keep in: emission at most {high:g} deg")
        left.set(xlim=(-1.1 * far, 1.1 * far), ylim=(-1.1 * far, 1.1 * far))
        right.set(title=f"keep out: emission at least {low:g} deg")
        ends = np.array([-1.6 * near, 1.3 * float(cut.point_m[0]) + 60.0])
        right.set(xlim=ends, ylim=0.5 * np.ptp(ends) * np.array([-1.0, 1.0]))
        for axes in (left, right):
            axes.set_xlabel("in the section, to the spacecraft (m)")
            axes.set_ylabel("in the section, across (m)")
        for space, planes, radius, side in zip(
            spaces, (inner, outer), (far, near), ("inside", "outside"), strict=True
        ):
            _cone_in_space(space, cut, polygon(planes), radius, height, far)
            title = f"{side}, {count} facets; site to section ({height:.0f} m)"
            space.set_title(title, y=1.0)
        legend(figure, 3, "outside lower center")
    return figure


def ball_polytopes(runs: Runs) -> Figure:
    """Keep-in on the left and keep-out on the right, in the plane of the widest spread.

    Polytopes are the paper's where the plan has tangent planes alone.
    """
    site, _, line, covariance = _at(runs.plan, "site_distance_max")
    sight = line / np.linalg.norm(line)
    across = np.eye(3) - np.outer(sight, sight)
    widest = np.linalg.eigh(across @ covariance @ across)[1][:, -1]
    frame = np.stack([sight, widest, np.cross(sight, widest)], axis=1)
    cut = Section(site, frame, frame.T @ line, frame.T @ covariance @ frame)
    own, limits = runs.plan.mission.polytopes, runs.plan.mission.scenario.observation
    polytopes = own if own.ball else replace(own, ball=paper_ball())
    low, high = limits.site_distance_min_m, limits.site_distance_max_m
    inner = cut.facets(Ball(site[None], high), polytopes, "in")
    outer = cut.facets(Ball(site[None], low), polytopes, "out")
    with page(4.0) as figure:
        left, right = figure.subplots(1, 2, subplot_kw={"aspect": "equal"})
        _keep_in(left, cut, inner, "sphere", high)
        _keep_out(right, cut, outer, "sphere", low)
        left.set_title(f"keep in: site distance at most {high:g} m")
        right.set_title(f"keep out: site distance at least {low:g} m")
        reach = (-1.08 * high, 1.08 * high)
        for axes in (left, right):
            axes.plot(0.0, 0.0, "k^", ms=5, label="site")
            axes.set(xlabel="to the spacecraft (m)", ylabel="across (m)", xlim=reach, ylim=reach)
        legend(figure, 3, "outside lower center")
    return figure


def _panels(figure: Figure, height: float) -> list[Any]:
    """Two sections above, and the same two in space below."""
    grid = figure.add_gridspec(2, 2, height_ratios=(height, 1.0))
    sections = [figure.add_subplot(grid[0, column], aspect="equal") for column in range(2)]
    for axes in sections:
        axes.set_axisbelow(True)
    spaces = [figure.add_subplot(grid[1, column], projection="3d") for column in range(2)]
    for space in spaces:
        space.computed_zorder = False  # what is drawn later lies above
        space.set_axis_off()
    return [*sections, *spaces]


def _keep_in(axes: Axes, cut: Section, planes: Halfspaces, name: str, radius_m: float) -> None:
    """Draw the polytope inside: all facets must hold."""
    label = f"inside, {len(planes.offset)} facets: all have to hold"
    look: Look = {"facecolor": "0.88", "edgecolor": "k", "lw": 1.4}
    axes.add_patch(Polygon(polygon(planes), label=label, **look))
    _region(axes, cut, name, radius_m)


def _keep_out(axes: Axes, cut: Section, planes: Halfspaces, name: str, radius_m: float) -> None:
    """Draw the polytope outside and the half-plane beyond its most probable facet, which must hold."""
    chosen = cut.most_probable(planes)
    across, offset = planes.normal[chosen, :2], planes.offset[chosen]
    length, far = float(np.linalg.norm(across)), 1e4
    normal, foot = across / length, across * offset / length**2
    along = far * np.array([-normal[1], normal[0]])
    line = np.stack([foot - along, foot + along])
    beyond = np.vstack([line, line[::-1] + far * normal])
    look: Look = {"facecolor": "0.88", "edgecolor": "none"}
    axes.add_patch(Polygon(beyond, label="allowed by the facet chosen", **look))
    axes.plot(*line.T, "k-", lw=1.8, label="facet chosen: it has to hold")
    ring = polygon(planes)
    label = f"outside, {len(planes.offset)} facets: one has to hold"
    axes.plot(*np.vstack([ring, ring[:1]]).T, color="C2", lw=1.4, label=label)
    _region(axes, cut, name, radius_m)


def _region(axes: Axes, cut: Section, name: str, radius_m: float) -> None:
    """The region's edge; the spacecraft with one and two standard deviations."""
    circle = np.stack([np.cos(TURN), np.sin(TURN)])
    axes.plot(*radius_m * circle, color="C0", lw=1.2, ls="--", label=f"{name} of the limit")
    factor = np.linalg.cholesky(cut.covariance_m2[:2, :2])
    for sigmas, dashes in ((1.0, "-"), (2.0, ":")):
        ellipse = cut.point_m[:2, None] + sigmas * factor @ circle
        axes.plot(*ellipse, color="C1", ls=dashes, lw=1.2, label=f"{sigmas:g} sigma")
    axes.plot(*cut.point_m[:2], "o", color="C1", ms=4, label="spacecraft")


def _cone_in_space(
    axes: Any, cut: Section, ring: Array, radius_m: float, height_m: float, reach_m: float
) -> None:
    """Cone and pyramid from the site up to the section, drawn as wide as `reach_m`."""
    azimuth, up = np.meshgrid(np.linspace(0, 2 * np.pi, 49), np.linspace(0.0, 1.0, 2))
    cone = (radius_m * up * np.cos(azimuth), radius_m * up * np.sin(azimuth), height_m * up)
    axes.plot_surface(*cone, color="0.75", alpha=0.35, linewidth=0, shade=False)
    axes.plot(*(x[-1] for x in cone), color="0.45", lw=1.0)
    for corner, following in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        axes.plot(*np.array([corner, following]).T, height_m, "k-", lw=1.2)
        axes.plot([0.0, corner[0]], [0.0, corner[1]], [0.0, height_m], "k-", lw=1.2)
    axes.plot(*([x] for x in cut.point_m[:2]), [height_m], "ko", ms=5)
    axes.text(0.0, 0.0, -0.06 * height_m, "site", ha="center", va="top")
    axes.set(xlim=(-reach_m, reach_m), ylim=(-reach_m, reach_m), zlim=(0.0, height_m))
    _view(axes, 1.33, 20.0, -55.0)


def _view(axes: Any, zoom: float, elevation_deg: float, azimuth_deg: float) -> None:
    axes.set_aspect("equal")
    axes.set_box_aspect(axes.get_box_aspect(), zoom=zoom)
    axes.view_init(elev=elevation_deg, azim=azimuth_deg)
