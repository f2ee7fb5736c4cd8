"""Draw the accuracy of simulated flights of a plan."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import chi

from formulations.arrays import Array
from paper_figs.drawing import ABOVE, page
from paper_figs.inputs import Source
from paper_figs.studies.flight_record import read_flight
from scp_recon.errors import InputError
from scp_recon.simulation.record import FILE_NAME, Record

SOURCE = Source(
    "flown_plan", "python -m experiments flown_plan SOLUTION", {"flown_plan.csv": "seed"}
)
RADIUS_SIGMA = 3.0


def read(folder: Path) -> list[Record]:
    """Read the study's flights, those that its table names.

    Raises:
        InputError: if a file is missing or unusable, or flights are of different plans or of
            another than a solution beside them.
    """
    anew = f"{SOURCE.command} --fresh"
    files = [folder / f"seed_{row['seed']}" / FILE_NAME for row in SOURCE.rows(folder)]
    records = [read_flight(file, folder, SOURCE.command, anew) for file in files]
    if len({record.plan_hash for record in records}) > 1:
        written = f"must be of one; written anew by `{anew} --out {folder}`"
        raise InputError(str(folder), "flights of different plans", written)
    return records


def draw(records: list[Record]) -> Figure:
    """Shares of the flights: within so many sigmas of the plan, left, and within an angle, right."""
    with page(3.6) as figure:
        left, right = figure.subplots(1, 2)
        _positions(left, _distances(records))
        _angles(right, records)
        for axes in (left, right):
            axes.set_ylim(0.0, 1.02)
            axes.legend(**ABOVE, ncols=2)
    return figure


def _distances(records: list[Record]) -> Array:
    """Distances from the planned mean in sigmas, shape (flights, nodes)."""
    return np.array([record.arrays["node_sigma_distance"] for record in records])


def _positions(axes: Axes, distances: Array) -> None:
    axes.ecdf(distances.ravel(), color="k", label="all nodes")
    axes.ecdf(distances[:, -1], color="tab:blue", label="final node")
    axes.ecdf(distances.max(axis=1), color="tab:orange", label="farthest node")
    reach = 1.05 * max(RADIUS_SIGMA, float(distances.max()))
    sigmas = np.linspace(0.0, reach, 200)
    axes.plot(sigmas, chi.cdf(sigmas, 3), color="0.5", ls="--", lw=1.0, label="normal position")
    axes.axvline(RADIUS_SIGMA, color="tab:red", lw=1.0, ls=":")
    axes.set(xlabel="distance from the planned mean (sigma)", ylabel="share (1)", xlim=(0.0, reach))


def _angles(axes: Axes, records: list[Record]) -> None:
    burns = [burn for record in records for burn in record.summary.burns]
    camera = [record.summary.window_pointing_deg.camera for record in records]
    # At time zero the attitude is what it should be, by construction.
    starts = [burn.pointing_deg for burn in burns if burn.t_s > 0.0]
    for angles, colour, label in (
        (starts, "k", "thrust at start"),
        ([burn.executed_pointing_deg for burn in burns], "tab:blue", "velocity gained"),
        ([spread.q50 for spread in camera], "tab:orange", "camera, median"),
        ([spread.q100 for spread in camera], "tab:red", "camera, largest"),
    ):
        axes.ecdf(angles, color=colour, label=label)
    axes.set(xlabel="angle to the command (deg)", xlim=(0.0, None))


def caption(records: list[Record]) -> str:
    """Describe the figure."""
    distances = _distances(records)
    inside = distances <= RADIUS_SIGMA
    charge = min(record.summary.least_charge for record in records)
    return (
        f"{len(records)} simulated flights of a plan with all errors. Left: share of the positions at "
        "the solution's nodes, of the final ones and of the farthest of each flight, by their distance "
        "from the planned mean in the planned covariance; dashed: a normal position; dotted: "
        f"{RADIUS_SIGMA:g} sigma, within which are {inside.mean():.3f} of all positions "
        f"({chi.cdf(RADIUS_SIGMA, 3):.3f} of normal ones) and {inside.all(axis=1).sum()} flights "
        "throughout. Right: share of the burns and windows by angle: thrust as a burn starts (but for "
        "the first) and velocity gained against the planned burn, median and largest angle of the "
        "camera to its command in the window. The least charge "
        f"is {100.0 * charge:.1f} %."
    )
