"""The body's shape from four sides and both poles, its surface in the colour of the nearest site."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize, to_rgba
from matplotlib.figure import Figure
from scipy.spatial import KDTree

from scp_recon.campaign.study.axes import LATITUDE, LONGITUDE
from scp_recon.campaign.view.labels import COLOURS, COST, DELTA_V, GREYS
from scp_recon.campaign.view.outcome import FEASIBLE, CampaignResults
from scp_recon.environment.surface import direction_of
from scp_recon.report.content.shape import Shape, shape_of

Array = npt.NDArray[np.float64]

VIEWS = {
    "from 0 E": (0.0, 0.0),
    "from 90 E": (0.0, 90.0),
    "from north": (90.0, 0.0),
    "from 180 E": (0.0, 180.0),
    "from 270 E": (0.0, 270.0),
    "from south": (-90.0, 0.0),
}
"""Latitude and longitude of the eye, far away."""
DARKEST = 0.55
"""Share of a colour that is left where a facet is seen edge on."""


def draw_globe(results: CampaignResults) -> Figure:
    """Delta-v of the nearest site on the surface; grey where it has no verified plan."""
    results = results.by_site
    shape = shape_of(results.base)
    rows = results.table
    directions = np.array(
        [direction_of(*at) for at in zip(rows[LATITUDE], rows[LONGITUDE], strict=True)]
    )
    sites = shape.radius(directions)[:, None] * directions
    costs = rows[COST].to_numpy(dtype=float)
    ends = np.array(results.ends)
    known = costs[ends == FEASIBLE]
    limits = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    scale = ScalarMappable(Normalize(*limits), COLOURS)
    colours = scale.to_rgba(np.where(ends == FEASIBLE, costs, np.nan))
    for end, grey in GREYS.items():
        colours[ends == end] = to_rgba(grey)
    figure = Figure(figsize=(7.0, 5.0), layout="constrained", dpi=120)
    grid = figure.subplots(2, 3)
    for axes, (name, eye) in zip(grid.flat, VIEWS.items(), strict=True):
        _view(axes, shape, sites, colours, eye)
        axes.set_title(name, fontsize=9)
    figure.colorbar(scale, ax=grid, label=DELTA_V, shrink=0.8)
    for end in dict.fromkeys(ends):
        if end in GREYS:
            grid.flat[0].scatter([], [], marker="s", color=GREYS[end], label=end)
    figure.legend(loc="outside lower center", ncols=3, frameon=False)
    return figure


def _view(axes: Axes, shape: Shape, sites: Array, colours: Array, eye: tuple[float, float]) -> None:
    """Facets that face the eye, from the farthest to the nearest."""
    towards = direction_of(*eye)
    up = np.array([0.0, 0.0, 1.0]) if abs(eye[0]) < 89.0 else direction_of(0.0, eye[1] + 180.0)
    up = up * (1.0 if eye[0] > -89.0 else -1.0)
    right = np.cross(up, towards)
    corners = shape.vertices_m[shape.facets]
    middles = corners.mean(axis=1)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = across @ towards / np.maximum(np.linalg.norm(across, axis=1), 1e-300)
    seen = np.flatnonzero(facing > 0.0)
    seen = seen[np.argsort(middles[seen] @ towards)]
    nearest = KDTree(sites).query(middles[seen])[1]
    shades = colours[nearest].copy()
    shades[:, :3] *= (DARKEST + (1.0 - DARKEST) * facing[seen])[:, None]
    flat = np.stack([corners[seen] @ right, corners[seen] @ up], axis=2)
    axes.add_collection(
        PolyCollection(list(flat), facecolors=shades, edgecolors=shades, lw=0.3, rasterized=True)
    )
    front = sites[sites @ towards > 0.0]
    axes.plot(front @ right, front @ up, "o", ms=1.5, color="k", mew=0)
    reach = 1.05 * float(np.linalg.norm(shape.vertices_m, axis=1).max())
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(False)
