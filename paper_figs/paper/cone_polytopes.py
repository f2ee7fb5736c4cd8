"""Draw the pyramids that approximate the emission cones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Ellipse, Polygon

from formulations.arrays import Array
from formulations.problem.facets import Polytopes, inner_facets, outer_facets
from formulations.problem.regions import Cone, Halfspaces
from paper_figs.drawing import legend, page
from paper_figs.inputs import Flown, Runs
from scp_recon.physics import geometry

MANY = 12
"""Facets of the pyramids drawn beside those of the scenario."""


@dataclass(frozen=True)
class Section:
    """Plane through the spacecraft across the site's normal, at one node.

    Attributes:
        time_s: of the node.
        height_m: of the plane above the site.
        point_m: the spacecraft in it, shape (2,); the first axis points from the normal to it.
        covariance_m2: of its position along the columns of `frame`, shape (3, 3).
        origin_m: where the normal pierces the plane, J2000, shape (3,).
        frame: the plane's axes and the normal as columns, J2000, shape (3, 3).
    """

    time_s: float
    height_m: float
    point_m: Array
    covariance_m2: Array
    origin_m: Array
    frame: Array


def binding_node(flown: Flown, name: str) -> int:
    """The node where a constraint is closest to binding; with exact risk its joint constraint."""
    found = (c.worst_t_s for c in flown.solution.constraints if name.startswith(c.name))
    return int(np.argmin(np.abs(flown.mission.times_s - next(found))))


def section(flown: Flown) -> Section:
    """The plane at the node where the upper emission limit is closest to binding."""
    mission, nodes = flown.mission, flown.solution.nodes
    node = binding_node(flown, "emission_max")
    track = geometry.track(mission.site, mission.rotation, mission.times_s[[node]])
    normal, site = track.normal[0], track.position[0]
    line = np.array(nodes.state[node][:3]) - site
    height = float(line @ normal)
    across = line - height * normal
    first = across / np.linalg.norm(across)
    frame = np.stack([first, np.cross(normal, first), normal], axis=1)
    covariance = np.array(nodes.covariance[node])[:3, :3]
    return Section(
        time_s=float(mission.times_s[node]),
        height_m=height,
        point_m=frame[:, :2].T @ line,
        covariance_m2=frame.T @ covariance @ frame,
        origin_m=site + height * normal,
        frame=frame,
    )


def polygon(planes: list[Halfspaces], cut: Section) -> Array:
    """Corners of a pyramid's section; its facets are in order about the axis, (n, 2)."""
    normal = np.stack([plane.normal[0] for plane in planes])
    offset = np.array([plane.offset[0] for plane in planes]) - normal @ cut.origin_m
    lines = normal @ cut.frame[:, :2]
    following = np.roll(np.arange(len(planes)), -1)
    pairs = np.stack([lines, lines[following]], axis=1)
    corners = np.linalg.solve(pairs, np.stack([offset, offset[following]], axis=1)[..., None])
    return np.asarray(corners[..., 0], dtype=float)


def pyramid(cut: Section, angle_deg: float, facets: int, keep: str) -> list[Halfspaces]:
    """Facets inside a cone about the normal, or around it, turned towards the spacecraft."""
    apex = (cut.origin_m - cut.height_m * cut.frame[:, 2])[None]
    cone = Cone(apex, cut.frame[None, :, 2], float(np.deg2rad(angle_deg)))
    place = inner_facets if keep == "in" else outer_facets
    point = cut.origin_m + cut.frame[:, :2] @ cut.point_m
    return place(cone, Polytopes(None, facets), point[None])


def most_probable(normals: Array, offsets: Array, point: Array, covariance: Array) -> int:
    """The facet beyond which a normal point is with the largest probability.

    Normals have shape (m, 3), offsets (m,); mean and covariance are along the same axes.
    """
    beyond = normals @ point - offsets
    deviation = np.sqrt(np.einsum("mi,ij,mj->m", normals, covariance, normals))
    return int(np.argmax(beyond / deviation))


def draw(runs: Runs) -> Figure:
    """Keep-in on the left and keep-out on the right, in the section above and in space below."""
    cut, limits = section(runs.plan), runs.plan.mission.scenario.observation
    facets = runs.plan.mission.polytopes.cone_facets
    with page(6.3) as figure:
        grid = figure.add_gridspec(2, 2, height_ratios=(1.5, 1.0))
        panels = [figure.add_subplot(grid[0, column]) for column in range(2)]
        _keep_in(panels[0], cut, limits.emission_max_deg, facets)
        _keep_out(panels[1], cut, limits.emission_min_deg, facets)
        for axes in panels:
            axes.set(
                xlabel="in the section, to the spacecraft (m)",
                ylabel="in the section, across (m)",
                aspect="equal",
            )
            axes.set_axisbelow(True)
        reach = cut.height_m * float(np.tan(np.deg2rad(limits.emission_max_deg)))
        for column, (keep, angle) in enumerate(
            (("in", limits.emission_max_deg), ("out", limits.emission_min_deg))
        ):
            space = figure.add_subplot(grid[1, column], projection="3d")
            _in_space(space, cut, angle, facets, keep, reach)
        legend(figure, 3, "outside lower center")
    return figure


def _keep_in(axes: Axes, cut: Section, angle_deg: float, facets: int) -> None:
    """Draw the pyramid whose edges lie on the cone: all facets must hold."""
    radius = cut.height_m * np.tan(np.deg2rad(angle_deg))
    axes.add_patch(
        Polygon(
            polygon(pyramid(cut, angle_deg, facets, "in"), cut), facecolor="0.88", edgecolor="k",
            lw=1.4, label=f"inside, {facets} facets: all have to hold",
        )
    )  # fmt: skip
    axes.add_patch(
        Polygon(
            polygon(pyramid(cut, angle_deg, MANY, "in"), cut), fill=False, edgecolor="k", ls="--",
            lw=0.9, label=f"inside, {MANY} facets",
        )
    )  # fmt: skip
    axes.add_patch(Circle((0, 0), radius, fill=False, lw=1.0, edgecolor="0.45", label="cone"))
    spacecraft(axes, cut.point_m, cut.covariance_m2[:2, :2])
    axes.set_title(f"keep in: emission at most {angle_deg:g} deg")
    axes.set(xlim=(-1.1 * radius, 1.1 * radius), ylim=(-1.1 * radius, 1.1 * radius))


def _keep_out(axes: Axes, cut: Section, angle_deg: float, facets: int) -> None:
    """Draw the pyramid whose facets touch the cone: the most probable one must hold."""
    radius = cut.height_m * np.tan(np.deg2rad(angle_deg))
    planes = pyramid(cut, angle_deg, facets, "out")
    normals = np.concatenate([plane.normal for plane in planes]) @ cut.frame
    offsets = np.concatenate([plane.offset for plane in planes]) - normals @ (
        cut.frame.T @ cut.origin_m
    )
    point = np.array([*cut.point_m, 0.0])
    corners = polygon(planes, cut)
    chosen = most_probable(normals, offsets, point, cut.covariance_m2)
    # Facet i ends at corner i and starts at the one before.
    ends = np.stack([corners[chosen - 1], corners[chosen]])
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    far = 3.0 * radius
    outward = cut.frame[:, :2].T @ planes[chosen].normal[0]
    outward = far * 2.0 * outward / np.linalg.norm(outward)
    line = np.stack([ends[0] - far * along, ends[1] + far * along])
    axes.add_patch(
        Polygon(
            np.vstack([line, line[::-1] + outward]), facecolor="0.88", edgecolor="none",
            label="allowed by the facet chosen",
        )
    )  # fmt: skip
    axes.plot(*line.T, "k-", lw=1.8, label="facet chosen: it has to hold")
    axes.add_patch(
        Polygon(corners, fill=False, edgecolor="0.6", lw=1.4, label=f"outside, {facets} facets")
    )
    axes.add_patch(Circle((0, 0), radius, fill=False, lw=1.0, edgecolor="0.45", label="cone"))
    spacecraft(axes, cut.point_m, cut.covariance_m2[:2, :2])
    axes.set_title(f"keep out: emission at least {angle_deg:g} deg")
    reach = 1.3 * float(cut.point_m[0])
    low = -1.6 * radius
    axes.set(
        xlim=(low, reach + 60.0), ylim=(-0.5 * (reach + 60.0 - low), 0.5 * (reach + 60.0 - low))
    )


def spacecraft(axes: Axes, point_m: Array, covariance_m2: Array) -> None:
    """The mean in a plane and its one and two standard deviations, shape (2,) and (2, 2)."""
    variance, direction = np.linalg.eigh(covariance_m2)
    angle = float(np.rad2deg(np.arctan2(direction[1, 1], direction[0, 1])))
    for sigmas, line in ((1.0, "-"), (2.0, ":")):
        width, height = 2.0 * sigmas * np.sqrt(variance[1]), 2.0 * sigmas * np.sqrt(variance[0])
        axes.add_patch(
            Ellipse(
                tuple(point_m), width, height, angle=angle, fill=False, ls=line, lw=1.2,
                label=f"{sigmas:g} sigma",
            )
        )  # fmt: skip
    axes.plot(*point_m, "ko", ms=4, label="spacecraft")


def _in_space(
    axes: Any, cut: Section, angle_deg: float, facets: int, keep: str, reach_m: float
) -> None:
    """Cone and pyramid from the site up to the section, drawn as wide as `reach_m`."""
    axes.computed_zorder = False  # what is drawn later lies above
    height = cut.height_m
    radius = height * np.tan(np.deg2rad(angle_deg))
    azimuth, up = np.meshgrid(np.linspace(0, 2 * np.pi, 49), np.linspace(0.0, 1.0, 2))
    axes.plot_surface(
        radius * up * np.cos(azimuth), radius * up * np.sin(azimuth), height * up,
        color="0.75", alpha=0.35, linewidth=0, shade=False,
    )  # fmt: skip
    circle = np.linspace(0, 2 * np.pi, 97)
    axes.plot(radius * np.cos(circle), radius * np.sin(circle), height, color="0.45", lw=1.0)
    planes = pyramid(cut, angle_deg, facets, keep)
    corners = polygon(planes, cut)
    for corner, following in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        x, y = np.array([corner, following]).T
        axes.plot(x, y, height, "k-", lw=1.2)
        axes.plot([0.0, corner[0]], [0.0, corner[1]], [0.0, height], "k-", lw=1.2)
    axes.plot(*([v] for v in cut.point_m), [height], "ko", ms=5)
    axes.text(0.0, 0.0, -0.06 * height, "site", ha="center", va="top")
    axes.set_axis_off()
    axes.set(xlim=(-reach_m, reach_m), ylim=(-reach_m, reach_m), zlim=(0.0, height))
    axes.set_aspect("equal")
    axes.set_box_aspect(axes.get_box_aspect(), zoom=1.33)
    axes.view_init(elev=20.0, azim=-55.0)
    axes.set_title(f"{keep}side, {facets} facets; site to section ({height:.0f} m)", y=1.0)


def caption(runs: Runs) -> str:
    """Describe the figure."""
    cut, limits = section(runs.plan), runs.plan.mission.scenario.observation
    facets = runs.plan.mission.polytopes.cone_facets
    return (
        "Polytopic approximation of the two emission cones about the normal of "
        f"{runs.plan.mission.scenario.site.name}, at {cut.time_s:.0f} s, where the upper limit is "
        f"closest to binding. Above: section across the normal, {cut.height_m:.0f} m above the site, "
        "through the spacecraft, with the ellipses of one (solid) and two (dotted) standard "
        "deviations of its position in the section. Left: to stay within "
        f"{limits.emission_max_deg:g} deg all {facets} facets of the inner pyramid have to hold, whose "
        f"edges lie on the cone, one of them towards the spacecraft; with {MANY} facets (dashed) the "
        f"pyramid is tighter. Right: to stay beyond {limits.emission_min_deg:g} deg one facet of the "
        "outer pyramid has to hold, whose facets touch the cone: the one with the largest "
        "probability (black); the others (grey) are not used. Below: the same pyramids between the "
        "site and the section. The pyramids are turned to the plan's own line of sight here; P2 uses "
        "those turned to P3's."
    )
