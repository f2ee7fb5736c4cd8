"""Write the paper's tables as Markdown: the scenario's parameters, and observation times."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from formulations.arrays import Array
from paper_figs.inputs import Row, Runs
from scp_recon.mission.mission import Mission
from scp_recon.results.table import Cell, Column, Table

Line = tuple[str, str, str]

TIMES = ("window", "without uncertainty", "mean", "worst 1 sigma")
HEADER = (
    Column("method"),
    *(Column(of, "s", ".0f") for of in (*TIMES, "paper: mean", "paper: worst 1 sigma")),
)


def observation_table(runs: Runs) -> str:
    """Markdown, the paper's columns with the paper's values beside ours."""
    rows = [row for row in runs.table if row["role"] != "variant"]
    samples = sorted({row["samples"] for row in rows if row["samples"]})
    return (
        f"# Observation times\n\n{Table.of('', HEADER, map(_line, rows)).markdown()}\n\n"
        f"Observation times of {', '.join(samples)} flights a row with their 95 % confidence "
        "intervals, the paper's printed values on the right. Worst 1 sigma is reached by all but "
        "15.9 % of the flights.\n"
    )


def _line(row: Row) -> Sequence[object]:
    printed = (float(row["paper_mean_s"]), float(row["paper_worst_1_sigma_s"]))
    if not row["mean_s"]:
        return (row["label"], row["status"], None, None, None, *printed)
    certain = (float(row[name]) for name in ("window_s", "without_uncertainty_s"))
    spread = (_with_interval(row, name) for name in ("mean_s", "worst_1_sigma_s"))
    return (row["label"], *certain, *spread, *printed)


def _with_interval(row: Row, name: str) -> Cell:
    value, *ends = (row[name], row[f"{name}_low"], row[f"{name}_high"])
    low, high = (f"{float(end):.0f}" if end else "" for end in ends)
    interval = f" ({low} to {high})" if low and high else ""
    return Cell(f"{float(value):.0f}{interval}", float(value))


def parameters(runs: Runs) -> str:
    """Markdown: parameter, symbol of the paper, value with its unit."""
    mission = runs.plan.mission
    lines = [*_constraints(mission), *_flight(mission), *_model(mission)]
    table = Table.of("", ("parameter", "symbol", "value"), lines).markdown()
    return f"# Parameters of the scenario {mission.scenario.name}\n\n{table}\n"


def _constraints(mission: Mission) -> Iterable[Line]:
    s, o = mission.scenario, mission.scenario.observation
    yield "site distance", "d_1, d_2", f"{o.site_distance_min_m:g} m, {o.site_distance_max_m:g} m"
    hours = f"{_clock(o.local_solar_time_min_h)}, {_clock(o.local_solar_time_max_h)}"
    yield f"{s.body.name} local solar time", "t_l1, t_l2", hours
    emission = f"{o.emission_min_deg:g} deg, {o.emission_max_deg:g} deg"
    yield "emission angle", "theta_e1, theta_e2", emission
    most = "none" if o.phase_max_deg is None else f"{o.phase_max_deg:g} deg"
    yield "phase angle", "theta_p1, theta_p2", f"{o.phase_min_deg:g} deg, {most}"
    yield "solar incidence angle", "theta_s1, theta_s2", f"none, {o.incidence_max_deg:g} deg"
    yield "largest burn", "Delta v_max", f"{s.burns.dv_max_m_s:g} m/s"
    yield "smallest distance from the centre", "h_min", f"{s.safety.radius_min_m:g} m"
    cones = f"{s.battery.delta_v_cone_deg:g} deg, {s.battery.observation_cone_deg:g} deg"
    yield "battery cones of burns, of observation", "theta_deltaV, theta_obs", cones
    yield "required probability", "p_chance", f"{100 * s.risk.p_chance:g} %"


def _flight(mission: Mission) -> Iterable[Line]:
    s = mission.scenario
    frame = {"sun_north": "Sun-North frame at t_0", "j2000": "J2000"}[s.boundary.frame]
    for symbol, which, converted in (
        ("x_0", "initial", mission.initial_state),
        ("x_f", "final", mission.final_state),
    ):
        position = getattr(s.boundary, f"{which}_position_m")
        velocity = getattr(s.boundary, f"{which}_velocity_m_s")
        yield f"{which} state, {frame}", symbol, _state(np.array([*position, *velocity]))
        if s.boundary.frame != "j2000":
            yield f"{which} state, J2000", symbol, _state(converted)
    times = ", ".join(f"{t:g} s" for t in s.burns.times_s)
    yield (
        "firing times",
        ", ".join(f"t_{i}" for i in (*range(len(s.burns.times_s) - 1), "f")),
        times,
    )
    first, last = mission.schedule.window_s
    window = f"{first:.1f} s, {last:.1f} s ({last - first:.1f} s)"
    origin = "given" if s.observation.window_s else "computed"
    yield f"observation window, {origin}", "t_1^o, t_2^o", window
    sun = ", ".join(f"{v:.4f}" for v in mission.sun_direction(0.0))
    yield "direction to the Sun at t_0, J2000", "r_center->sun", f"[{sun}]"
    yield "epoch", "t_0", f"{s.epoch.tdb.isoformat()} TDB"
    arcs = np.diff(mission.times_s)
    grid = f"{arcs.min():.1f} s to {arcs.max():.1f} s, {len(mission.times_s)} nodes"
    yield "time step", "Delta t", grid


def _model(mission: Mission) -> Iterable[Line]:
    s = mission.scenario
    yield "site, body-fixed", "r_site", f"[{_listed(s.site.position_body_m)}] m"
    yield "site normal, body-fixed", "r_s_perp", f"[{_listed(s.site.normal_body)}]"
    error, fraction = s.uncertainty.execution_error, s.uncertainty.initial_sigma_fraction
    if error is None:
        yield "execution errors, 1 sigma", "C", s.uncertainty.execution
    else:
        yield "execution error, 1 sigma", "beta", f"{error:g}"
    if fraction is None:
        sigmas = ", ".join(f"{sigma:g}" for sigma in mission.initial_sigma)
        yield "initial 1 sigma, J2000, m and m/s", "Sigma_t0", f"[{sigmas}]"
    else:
        yield "initial covariance, J2000", "Sigma_t0", f"{fraction**2:g} diag(x_0 o x_0)"
    yield "gravity", "GM", f"{s.body.gm_m3_s2:.6f} m^3/s^2"
    yield "oblateness, unnormalised", "J_2", f"{s.body.j2:.6f} at {s.body.reference_radius_m:g} m"
    craft = s.spacecraft
    area = f"{craft.srp_area_m2:g} m^2, {craft.reflectivity_coefficient:g}, {craft.mass_kg:g} kg"
    yield "solar pressure: area, reflectivity, mass", "A, C_R, m", area
    polytopes = f"ball {s.polytopes.ball}, cone {s.polytopes.cone}"
    yield "polytopes", "a_ij, b_ij", polytopes


def _state(state: Array) -> str:
    position = ", ".join(f"{v / 1000.0:.4f}" for v in state[:3])
    velocity = ", ".join(f"{v:.4f}" for v in state[3:])
    return f"[{position}] km, [{velocity}] m/s"


def _listed(vector: Iterable[float]) -> str:
    return ", ".join(f"{v:g}" for v in vector)


def _clock(hour: float) -> str:
    return f"{int(hour):02d}:{round(60 * (hour % 1)):02d}"
