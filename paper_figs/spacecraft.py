"""Draw the studies of the spacecraft: simulated flights, power, timing, models and errors left out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import cycle, pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from pandas import DataFrame as Table
from scipy.stats import chi

from formulations.arrays import Array
from paper_figs.drawing import ABOVE, Look, quantile_panels
from scp_recon.results.pictures import HOUR_S, legend, page
from scp_recon.simulation.flight import Actuators
from scp_recon.simulation.record import Record

COLOURS = ("k", "C0", "C4", "C2", "C1")
DASHES = ("-", "-", "-", "-", "--")
"""The last two panels are equal: the one is seen through the other."""
TORQUES = {"thruster": ("micro-thrusters", "C1"), "wheel": ("wheels", "k")}
LEAST_MN_M = 1e-3
"""Smallest torque shown, mN m; torques are pulses."""
RADIUS_SIGMA = 3.0
TOGETHER = "together"
MODELS = (
    ("none", "k", ":"),
    ("cannonball", "k", "-"),
    ("degree 0", "C0", ":"),
    ("J2", "C0", "-"),
    ("impulsive", "C4", "-"),
)
"""Models whose distance is drawn over time, with their looks."""
WORDS = {"none": "no light pressure", "degree 0": "point mass"}
"""For models whose names say too little."""
SHOWN = ("initial_state", "chemical_thruster")
REACH = 5.5
"""Standard deviations shown of the quantiles."""


def attitude_and_actuators(record: Record) -> Figure:
    """Quaternion and command, the angle between them, torque, speed of the wheels, mode."""
    arrays, time = record.arrays, record.arrays["t_s"] / HOUR_S
    with page(7.6) as figure:
        rows = figure.subplots(5, 1, sharex=True, height_ratios=(3, 1.6, 1.9, 1.9, 1.1))
        command = _continuous(arrays["command"])
        turned = np.einsum("ni,ni->n", arrays["attitude"], command) < 0.0
        true = arrays["attitude"] * np.where(turned, -1.0, 1.0)[:, None]
        for i, name in enumerate(("scalar", "x", "y", "z")):
            rows[0].plot(time, true[:, i], color=COLOURS[i], lw=1.2, label=name)
            rows[0].plot(time, command[:, i], color=COLOURS[i], lw=0.9, ls="--")
        rows[0].plot([], [], color="0.5", lw=0.9, ls="--", label="command")
        rows[0].set(ylabel="quaternion (body to J2000)", ylim=(-1.05, 1.05))
        error = np.rad2deg(arrays["pointing_error_rad"])
        rows[1].semilogy(np.arange(len(error)) / HOUR_S, error, color="k", lw=0.5)
        rows[1].set(ylabel="error (deg)", ylim=(1e-3, 300.0), yticks=[1e-2, 1.0, 1e2])
        for name, (words, colour) in TORQUES.items():
            size = 1000.0 * np.linalg.norm(arrays[f"{name}_torque_n_m"], axis=1)
            acting = np.where(size > LEAST_MN_M, size, np.nan)
            rows[2].semilogy(time, acting, ".", ms=1.5, color=colour)
            rows[2].plot([], [], "o", ms=4, color=colour, label=words)
        rows[2].set(ylabel="torque (mN m)", ylim=(LEAST_MN_M, 30.0))
        rows[2].set_yticks([1e-3, 1e-2, 1e-1, 1.0, 10.0])
        dumping = _intervals(arrays["actuators"] == Actuators.BOTH.value, time)
        for start, length in dumping:
            rows[3].axvspan(start, start + length, facecolor="0.75", lw=0)
        speeds = zip(arrays["wheel_speed_rad_s"].T, cycle(COLOURS[:4]), strict=False)
        for i, (speed, colour) in enumerate(speeds, start=1):
            rows[3].plot(time, speed, color=colour, lw=1.0, label=f"wheel {i}")
        rows[3].fill([], [], color="0.75", label="dumping")
        rows[3].set_ylabel("speed (rad/s)")
        for value in range(len(record.summary.modes)):
            spans = list(_intervals(arrays["mode"] == value, time))
            rows[4].broken_barh(spans, (value - 0.36, 0.72), facecolor="0.35", lw=0)
        rows[4].set_yticks(range(len(record.summary.modes)), record.summary.modes)
        rows[4].set(ylim=(len(record.summary.modes) - 0.4, -0.6), xlabel="time (h)")
        rows[4].grid(visible=False)
        for axes, ncols in ((rows[0], 5), (rows[2], 2), (rows[3], 6)):
            axes.legend(**ABOVE, ncols=ncols)
        _mark_burns(rows, record)
    return figure


def _continuous(quaternions: Array) -> Array:
    """The same attitudes with signs that keep neighbours close, shape (n, 4)."""
    turned = np.einsum("ni,ni->n", quaternions[1:], quaternions[:-1]) < 0.0
    signs = np.cumprod(np.where(turned, -1.0, 1.0))
    return quaternions * np.concatenate([[1.0], signs])[:, None]


def _intervals(inside: Array, time: Array) -> Iterator[tuple[float, float]]:
    """Start and length of every interval in which the samples are inside."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], inside.astype(int), [0]])))
    ends = np.append(time, time[-1])
    for first, last in edges.reshape(-1, 2).tolist():
        yield float(ends[first]), float(ends[last] - ends[first])


def _mark_burns(rows: Sequence[Axes], record: Record) -> None:
    """Draw a line at every burn that is not zero, and show the whole flight."""
    for axes in rows:
        for burn in (one for one in record.summary.burns if any(one.planned_m_s)):
            axes.axvline(burn.t_s / HOUR_S, color="0.3", lw=0.8, ls=":")
    rows[-1].set_xlim(0.0, float(record.arrays["t_s"][-1]) / HOUR_S)


def power_history(record: Record) -> Figure:
    """Generation and consumption, each panel with its maximum, state of charge."""
    arrays, time = record.arrays, record.arrays["t_s"] / HOUR_S
    panels, peaks = arrays["panel_w"][1:], arrays["panel_peak_w"].tolist()
    with page(6.0) as figure:
        rows = figure.subplots(3, 1, sharex=True, height_ratios=(2, 2.4, 1.2))
        top, middle, bottom = rows
        top.plot(time[1:], panels.sum(axis=1), color="k", label="generated")
        top.plot(time, arrays["consumed_w"], color="C1", lw=1.0, label="consumed")
        top.set(ylabel="power (W)", ylim=(0.0, None))
        for i, (peak, colour, dash) in enumerate(zip(peaks, COLOURS, DASHES, strict=False)):
            middle.plot(time[1:], panels[:, i], dash, color=colour, lw=1.2, label=f"SP{i + 1}")
            middle.axhline(peak, color=colour, ls=":", lw=1.0)
        middle.set(ylabel="power of each panel (W)", ylim=(-4.0, 1.08 * max(peaks)))
        charge, floor = 100.0 * arrays["state_of_charge"], 100.0 * record.summary.floor_charge
        for i, look in enumerate(("-", "--")[: charge.shape[1]]):
            bottom.plot(time, charge[:, i], look, color=COLOURS[i], label=f"battery {i + 1}")
        bottom.axhline(floor, color="0.4", ls=":", lw=1.0)
        bottom.annotate("floor", (0.0, floor), (4, 3), textcoords="offset points")
        bottom.set(ylabel="charge (%)", ylim=(0.0, 112.0), xlabel="time (h)")
        top.legend(**ABOVE, ncols=2)
        middle.legend(**ABOVE, ncols=len(peaks))
        bottom.legend(loc="center right")
        _mark_burns(rows, record)
    return figure


def flown_plan(records: list[Record]) -> Figure:
    """Shares of the flights: within so many sigmas of the plan, left, and within an angle, right."""
    distances = np.array([record.arrays["node_sigma_distance"] for record in records])
    burns = [burn for record in records for burn in record.summary.burns]
    camera = [record.summary.window_pointing_deg.camera for record in records]
    # At time zero the attitude is what it should be, by construction.
    starts = [burn.pointing_deg for burn in burns if burn.t_s > 0.0]
    reach = 1.05 * max(RADIUS_SIGMA, float(distances.max()))
    sigmas = np.linspace(0.0, reach, 200)
    with page(3.6) as figure:
        left, right = figure.subplots(1, 2)
        for axes, values, colour, label in (
            (left, distances.ravel(), "k", "all nodes"),
            (left, distances[:, -1], "C0", "final node"),
            (left, distances.max(axis=1), "C4", "farthest node"),
            (right, starts, "k", "thrust at start"),
            (right, [burn.executed_pointing_deg for burn in burns], "C0", "velocity gained"),
            (right, [spread.q50 for spread in camera], "C4", "camera, median"),
            (right, [spread.q100 for spread in camera], "C1", "camera, largest"),
        ):
            axes.ecdf(values, color=colour, label=label)
        left.plot(sigmas, chi.cdf(sigmas, 3), color="0.5", ls="--", lw=1.0, label="normal position")
        left.axvline(RADIUS_SIGMA, color="C1", lw=1.0, ls=":")
        left.set(xlabel="distance from the planned mean (sigma)", ylabel="share (1)")
        left.set_xlim(0.0, reach)
        right.set(xlabel="angle to the command (deg)", xlim=(0.0, None))
        for axes in (left, right):
            axes.set_ylim(0.0, 1.02)
            axes.legend(**ABOVE, ncols=2)
    return figure


def battery_cones(tables: list[Table]) -> Figure:
    """Both halves of the sphere as seen along the Sun line, and generation against the angle to it."""
    cones, samples = tables
    calibrated = cones[cones.calibrated.eq(True)]
    loads = list(zip(calibrated.itertuples(), ("k", "C1"), strict=True))
    titles = "sunward half, seen from the Sun", "anti-sunward half, same view"
    with page(5.9) as figure:
        grid = figure.add_gridspec(2, 2, height_ratios=(1.5, 1.0))
        halves = [figure.add_subplot(grid[0, k]) for k in range(2)]
        look: Look = {"s": 7.0, "cmap": "cividis", "lw": 0, "rasterized": True}
        look |= {"vmin": 0.0, "vmax": samples.power_w.max()}
        for axes, seen, title in zip(halves, (samples.x > 0, samples.x < 0), titles, strict=True):
            half = samples[seen]
            points = axes.scatter(half.y, half.z, c=half.power_w, **look)
            for cone, colour in loads:
                radius = np.sin(np.deg2rad(cone.half_angle_deg))
                label = f"{cone.load_w:.0f} W, {cone.mode}: {cone.half_angle_deg:.1f} deg"
                axes.add_patch(Circle((0.0, 0.0), radius, fill=False, ec="w", lw=3.0))
                axes.add_patch(Circle((0.0, 0.0), radius, fill=False, ec=colour, lw=1.5))
                axes.plot([], [], color=colour, lw=1.5, label=label)
            axes.grid(visible=False)
            axes.set_title(title, loc="left")
            axes.set(xlabel="y, across the Sun (km)", aspect="equal")
            axes.set(xlim=(-1.05, 1.05), ylim=(-1.05, 1.05))
        halves[0].set_ylabel("z, to the pole (km)")
        figure.colorbar(points, ax=halves, shrink=0.7, label="best generation (W)")
        profile = figure.add_subplot(grid[1, :])
        angle = np.rad2deg(np.arccos(samples.x.clip(-1.0, 1.0)))
        profile.plot(angle, samples.power_w, ".", ms=1.5, color="0.45", rasterized=True)
        for cone, colour in loads:
            profile.axhline(cone.load_w, color=colour, lw=1.0, ls="--")
            for edge in (cone.half_angle_deg, 180.0 - cone.half_angle_deg):
                profile.axvline(edge, color=colour, lw=1.0)
        profile.set_xlabel("angle of the position to the Sun line (deg)")
        profile.set(ylabel="best generation (W)", xlim=(0.0, 180.0), ylim=(0.0, None))
        profile.set_xticks(np.arange(0, 181, 30))
        offset: Look = {"ha": "center", "textcoords": "offset points"}
        profile.annotate("shadow", (171.0, 0.0), (0, 4), **offset)
        legend(figure, 2)
    return figure


def model_fidelity(tables: list[Table]) -> Figure:
    """Every model's distance at the end, left, and that of some over the flight, right."""
    table, past = tables
    limit_m, flight = float(table.limit_m.iloc[0]), past.flight.iloc[0]
    with page(4.4) as figure:
        left, right = figure.subplots(1, 2)
        _at_the_end(left, table[table.effect != TOGETHER], limit_m)
        for model, colour, dashes in MODELS:
            own = past[(past.flight == flight) & (past.model == model)]
            look: Look = {
                "color": colour,
                "ls": dashes,
                "lw": 1.2,
                "label": WORDS.get(model, model),
            }
            right.plot(own.t_s / HOUR_S, own.distance_m, **look)
        right.axhline(limit_m, color="C1", lw=1.0, ls="--", label=f"{limit_m:g} m")
        right.set(xlabel="time (h)", ylabel="distance from the truth (m)", xlim=(0.0, None))
        right.set(yscale="log", ylim=(1e-2, 30.0))
        right.yaxis.set_major_formatter("{x:g}")
        right.set_title(f"over time, {flight}", loc="left")
        right.legend(loc="lower right")
    return figure


def _at_the_end(axes: Axes, rows: Table, limit_m: float) -> None:
    effects = list(rows.effect.unique())
    pairs = dict.fromkeys(zip(rows.effect, rows.model, strict=True))
    names = sorted(pairs, key=lambda name: effects.index(name[0]))
    for (flight, own), marker in zip(rows.groupby("flight", sort=False), "os", strict=False):
        places = [names.index(name) for name in zip(own.effect, own.model, strict=True)]
        fills = np.where(own.lowest_that_passes.eq(True), "k", "none")
        look: Look = {"marker": marker, "ec": "k", "s": 28, "lw": 0.9, "zorder": 3}
        axes.scatter(own.terminal_m, places, c=fills, **look)
        axes.plot([], [], marker, mfc="none", mec="k", ms=5, label=flight)
    axes.axvspan(limit_m, 1e6, facecolor="0.9", edgecolor="none")
    for edge, (one, two) in enumerate(pairwise(names)):
        if one[0] != two[0]:
            axes.axhline(edge + 0.5, color="0.6", lw=0.8)
    axes.set_yticks(range(len(names)), [WORDS.get(model, model) for _, model in names])
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="distance at the end (m)", xlim=(1e-5, 3e2))
    axes.set_title("filled: lowest fidelity that passes", loc="left")
    look = {"frameon": True, "edgecolor": "none", "framealpha": 1.0}
    axes.legend(loc="upper left", **look)


def timing_rules(tables: list[Table]) -> Figure:
    """Measured durations against those of the schedule."""
    rules, half_turns = tables
    with page(2.4) as figure:
        axes = figure.subplots()
        slews = half_turns["settled_0.25_deg_s"] / 60.0
        axes.barh(rules.index, rules.allowed_s / 60.0, 0.6, color="0.88", label="schedule")
        axes.plot(slews, [0.0] * len(slews), "|", ms=9, color="k", label="each half turn")
        for holds, colour, label in (
            (True, "k", "measured, holds"),
            (False, "C1", "measured, too long"),
        ):
            own = rules[rules.holds.eq(holds)]
            axes.plot(own.measured_s / 60.0, own.index, "o", color=colour, label=label)
        axes.set_yticks(rules.index, rules.name + ":\n" + rules.how)
        axes.set(xlabel="duration (min)", xlim=(0.0, None))
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        legend(figure, 4)
    return figure


def uncertainty_sources(tables: list[Table]) -> Figure:
    """Dispersion at the end of the flight by source, with intervals, on a logarithmic scale."""
    (rows,) = tables
    spread = rows[rows.rms_m > 0.0].reset_index()
    with page(0.9 + 0.34 * len(spread)) as figure:
        axes = figure.subplots()
        for (engine, own), marker in zip(
            spread.groupby("flown_by", sort=False), "os", strict=False
        ):
            counts = " or ".join(map(str, sorted(own.flights.unique())))
            look: Look = {"fmt": marker, "mfc": "w", "mec": "k", "ecolor": "k", "capsize": 3}
            ends = (own.rms_m - own.rms_m_low, own.rms_m_high - own.rms_m)
            label = f"{engine}, {counts} flights"
            axes.errorbar(own.rms_m, own.index, xerr=ends, label=label, **look)
        axes.set_yticks(spread.index, spread.label + ": " + spread.sigma.fillna(""))
        decades = np.log10([spread.rms_m_low.min(), spread.rms_m_high.max()])
        axes.set(xscale="log", xlim=10.0 ** np.array([np.floor(decades[0]), np.ceil(decades[1])]))
        axes.set_xlabel("rms distance from the flight without errors at the end (m)")
        axes.set_ylim(len(spread) - 0.5, -0.5)
        legend(figure, 2)
    return figure


def uncertainty_quantiles(tables: list[Table]) -> Figure:
    """A quantile-quantile panel per source and axis, J2000."""
    points, tests = tables
    panels = {}
    for source in SHOWN:
        test = tests[tests.source == source].iloc[0]
        for axis in "xyz":
            own = points[(points.source == source) & (points.axis == axis)]
            title = f"{test.label}, {axis}\np-value {test[f'p_value_{axis}']:.1g}"
            panels[title] = own.expected.to_numpy(), own.observed.to_numpy()
    with page(5.2) as figure:
        quantile_panels(figure, panels, REACH)
    return figure
