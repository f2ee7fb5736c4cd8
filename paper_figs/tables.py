"""Write the paper's tables as Markdown: the scenario's parameters, and observation times."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np
import pandas as pd

from formulations.arrays import Array
from paper_figs.inputs import Runs
from scp_recon.mission.mission import Mission
from scp_recon.results.table import Cell, Column, Table

TIMES = ("window", "without uncertainty", "mean", "worst 1 sigma")
HEADER = (
    Column("method"),
    *(Column(of, "s", ".0f") for of in (*TIMES, "paper: mean", "paper: worst 1 sigma")),
)


def observation_table(runs: Runs) -> str:
    """Markdown, the paper's columns with the paper's values beside ours."""
    table = pd.DataFrame(columns=["role", "samples"]) if runs.table is None else runs.table
    rows = table[table.role != "variant"]
    samples = ", ".join(f"{count:.0f}" for count in sorted(rows.samples.dropna().unique()))
    lines = map(_line, rows.to_dict("records"))
    return (
        f"# Observation times\n\n{Table.of('', HEADER, lines).markdown()}\n\n"
        f"Observation times of {samples} flights a row with their 95 % confidence "
        "intervals, the paper's printed values on the right. Worst 1 sigma is reached by all but "
        "15.9 % of the flights.\n"
    )


def _line(row: dict[str, float]) -> tuple[object, ...]:
    printed = row["paper_mean_s"], row["paper_worst_1_sigma_s"]
    if np.isnan(row["mean_s"]):
        return (row["label"], row["status"], None, None, None, *printed)
    spread = (_with_interval(row, name) for name in ("mean_s", "worst_1_sigma_s"))
    return (row["label"], row["window_s"], row["without_uncertainty_s"], *spread, *printed)


def _with_interval(row: dict[str, float], name: str) -> Cell:
    ends = np.array([row[f"{name}_low"], row[f"{name}_high"]])
    interval = "" if np.isnan(ends).any() else f" ({ends[0]:.0f} to {ends[1]:.0f})"
    return Cell(f"{row[name]:.0f}{interval}", row[name])


def parameters(runs: Runs) -> str:
    """Markdown: parameter, symbol of the paper, value with its unit."""
    mission = runs.plan.mission
    table = Table.of("", ("parameter", "symbol", "value"), list(_parameters(mission))).markdown()
    return f"# Parameters of the scenario {mission.scenario.name}\n\n{table}\n"


def _parameters(mission: Mission) -> Iterator[tuple[str, str, str]]:
    s, o, body = mission.scenario, mission.scenario.observation, mission.scenario.body
    phase = "none" if o.phase_max_deg is None else f"{o.phase_max_deg:g} deg"
    hours = f"{_clock(o.local_solar_time_min_h)}, {_clock(o.local_solar_time_max_h)}"
    cones = f"{s.battery.delta_v_cone_deg:g} deg, {s.battery.observation_cone_deg:g} deg"
    yield "site distance", "d_1, d_2", f"{o.site_distance_min_m:g} m, {o.site_distance_max_m:g} m"
    yield f"{body.name} local solar time", "t_l1, t_l2", hours
    emission = f"{o.emission_min_deg:g} deg, {o.emission_max_deg:g} deg"
    yield "emission angle", "theta_e1, theta_e2", emission
    yield "phase angle", "theta_p1, theta_p2", f"{o.phase_min_deg:g} deg, {phase}"
    yield "solar incidence angle", "theta_s1, theta_s2", f"none, {o.incidence_max_deg:g} deg"
    yield "largest burn", "Delta v_max", f"{s.burns.dv_max_m_s:g} m/s"
    yield "smallest distance from the centre", "h_min", f"{s.safety.radius_min_m:g} m"
    yield "battery cones of burns, of observation", "theta_deltaV, theta_obs", cones
    yield "required probability", "p_chance", f"{100 * s.risk.p_chance:g} %"
    frame = {"sun_north": "Sun-North frame at t_0", "j2000": "J2000"}[s.boundary.frame]
    for symbol, which in (("x_0", "initial"), ("x_f", "final")):
        ends = (getattr(s.boundary, f"{which}_{of}") for of in ("position_m", "velocity_m_s"))
        yield f"{which} state, {frame}", symbol, _state(np.concatenate([*ends]))
        if s.boundary.frame != "j2000":
            yield f"{which} state, J2000", symbol, _state(getattr(mission, f"{which}_state"))
    symbols = ", ".join(f"t_{i}" for i in (*range(len(s.burns.times_s) - 1), "f"))
    yield "firing times", symbols, ", ".join(f"{t:g} s" for t in s.burns.times_s)
    first, last = mission.schedule.window_s
    origin = "given" if o.window_s else "computed"
    window = f"{first:.1f} s, {last:.1f} s ({last - first:.1f} s)"
    yield f"observation window, {origin}", "t_1^o, t_2^o", window
    sun = ", ".join(f"{v:.4f}" for v in mission.sun_direction(0.0))
    yield "direction to the Sun at t_0, J2000", "r_center->sun", f"[{sun}]"
    yield "epoch", "t_0", f"{s.epoch.tdb.isoformat()} TDB"
    arcs = np.diff(mission.times_s)
    grid = f"{arcs.min():.1f} s to {arcs.max():.1f} s, {len(mission.times_s)} nodes"
    yield "time step", "Delta t", grid
    yield "site, body-fixed", "r_site", f"[{_listed(s.site.position_body_m)}] m"
    yield "site normal, body-fixed", "r_s_perp", f"[{_listed(s.site.normal_body)}]"
    error, fraction = s.uncertainty.execution_error, s.uncertainty.initial_sigma_fraction
    if error is None:
        yield "execution errors, 1 sigma", "C", s.uncertainty.execution
    else:
        yield "execution error, 1 sigma", "beta", f"{error:g}"
    if fraction is None:
        sigmas = f"[{_listed(mission.initial_sigma)}]"
        yield "initial 1 sigma, J2000, m and m/s", "Sigma_t0", sigmas
    else:
        yield "initial covariance, J2000", "Sigma_t0", f"{fraction**2:g} diag(x_0 o x_0)"
    yield "gravity", "GM", f"{body.gm_m3_s2:.6f} m^3/s^2"
    yield "oblateness, unnormalised", "J_2", f"{body.j2:.6f} at {body.reference_radius_m:g} m"
    craft = s.spacecraft
    area = f"{craft.srp_area_m2:g} m^2, {craft.reflectivity_coefficient:g}, {craft.mass_kg:g} kg"
    yield "solar pressure: area, reflectivity, mass", "A, C_R, m", area
    yield "polytopes", "a_ij, b_ij", f"ball {s.polytopes.ball}, cone {s.polytopes.cone}"


def _state(state: Array) -> str:
    position = ", ".join(f"{v / 1000.0:.4f}" for v in state[:3])
    velocity = ", ".join(f"{v:.4f}" for v in state[3:])
    return f"[{position}] km, [{velocity}] m/s"


def _listed(vector: Iterable[float]) -> str:
    return ", ".join(f"{v:g}" for v in vector)


def _clock(hour: float) -> str:
    return f"{int(hour):02d}:{round(60 * (hour % 1)):02d}"
