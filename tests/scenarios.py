"""Random scenarios around Reconnaissance B, most of which can be flown, and their plans."""

from functools import lru_cache

import numpy as np
from hypothesis import strategies as st

from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import Plan, plan
from scp_recon.scenario.load import load_scenario

RECON_B = load_scenario()
COARSE, FINE = "grid.step_max_s=450.0", "grid.step_max_s=100.0"
"""Half the nodes: what is tested here does not depend on the grid, and takes a third of the time."""


def turned(vector: tuple[float, ...], degrees: tuple[float, float]) -> list[float]:
    """A body-fixed vector at another longitude and latitude."""
    size = float(np.linalg.norm(vector))
    x, y, z = vector
    longitude = np.arctan2(y, x) + np.deg2rad(degrees[0])
    latitude = np.arcsin(z / size) + np.deg2rad(degrees[1])
    across = np.cos(latitude)
    unit = across * np.cos(longitude), across * np.sin(longitude), np.sin(latitude)
    return [size * float(u) for u in unit]


def shares(largest: float) -> st.SearchStrategy[float]:
    """Errors as shares of a component: none, or those that the schema allows."""
    return st.just(0.0) | st.floats(1e-9, largest)


@st.composite
def scenarios(draw: st.DrawFn) -> tuple[str, ...]:
    """Overrides of times, window, site, sizes, errors, risk and polytopes."""

    def near(value: float, size: float) -> float:
        return round(value + draw(st.floats(-size, size)), 6)

    boundary, site = RECON_B.boundary, RECON_B.site
    turn = draw(st.floats(-6.0, 6.0)), draw(st.floats(-6.0, 6.0))
    chosen = [
        f"burns.times_s=[0.0, {near(7600, 700)}, {near(25000, 1500)}, {near(34842, 1500)}]",
        f"burns.dv_max_m_s={draw(st.floats(0.06, 0.3))}",
        f"boundary.initial_position_m={[near(x, 30.0) for x in boundary.initial_position_m]}",
        f"boundary.final_position_m={[near(x, 60.0) for x in boundary.final_position_m]}",
        f"boundary.final_velocity_m_s={[near(v, 0.005) for v in boundary.final_velocity_m_s]}",
        f"site.position_body_m={turned(site.position_body_m, turn)}",
        f"site.normal_body={turned(site.normal_body, turn)}",
        f"observation.site_distance_max_m={near(750, 40)}",
        f"safety.radius_min_m={near(420, 130)}",
        f"uncertainty.execution_error={draw(shares(0.12))}",
        f"uncertainty.initial_sigma_fraction={draw(shares(0.012))}",
        f"risk.p_chance={draw(st.floats(0.55, 0.9))}",
        f"polytopes.ball={draw(st.sampled_from(['paper', 8, 24, 60]))}",
        f"polytopes.cone={draw(st.sampled_from(['paper', 6, 12]))}",
        COARSE,
    ]
    if draw(st.booleans()):
        first = near(13400, 300)
        chosen.append(f"observation.window_s=[{first}, {first + draw(st.floats(600, 3000))}]")
    return tuple(chosen)


WIDE = (
    *("observation.site_distance_min_m=450.0", "observation.site_distance_max_m=850.0"),
    *("observation.emission_min_deg=10.0", "observation.emission_max_deg=60.0"),
    *("observation.phase_min_deg=5.0", "battery.observation_cone_deg=10.0"),
    *("battery.delta_v_cone_deg=10.0", "safety.radius_min_m=400.0", "burns.dv_max_m_s=0.3"),
)
"""Limits that plans near that of Reconnaissance B keep with room to spare."""


@lru_cache(maxsize=1)
def reference() -> tuple[Mission, Plan]:
    """Reconnaissance B as it is, on the coarse grid."""
    return planned((COARSE,))


@st.composite
def generous(draw: st.DrawFn) -> tuple[str, ...]:
    """Overrides that are feasible by construction: burns are drawn and flown, and lead where they lead.

    The burns are near those of Reconnaissance B, whose limits are widened and whose errors and risk
    are halved, so that they are a plan.
    """
    mission, found = reference()
    speed = mission.units.speed_m_s
    burns = found.final.result.lin.iterate.burns * speed
    size = st.floats(-2e-3, 2e-3)
    drawn = np.array([[draw(size) for _ in range(3)] for _ in burns])
    flown = mission.dynamics.rollout(mission.problem.initial_state, (burns + drawn) / speed)
    states = {"initial": mission.initial_state, "final": flown[-1] * mission.units.state}
    boundary = [
        f"boundary.{which}_{entry}={state[part].tolist()}"
        for which, state in states.items()
        for entry, part in (("position_m", slice(3)), ("velocity_m_s", slice(3, 6)))
    ]
    return (
        COARSE,
        "boundary.frame=j2000",
        *boundary,
        *WIDE,
        f"uncertainty.execution_error={draw(shares(0.04))}",
        f"uncertainty.initial_sigma_fraction={draw(shares(0.005))}",
        f"risk.p_chance={draw(st.floats(0.55, 0.85))}",
        f"polytopes.ball={draw(st.sampled_from(['paper', 24, 60]))}",
        f"polytopes.cone={draw(st.sampled_from(['paper', 6, 12]))}",
    )


@lru_cache(maxsize=8)
def planned(overrides: tuple[str, ...]) -> tuple[Mission, Plan]:
    """A scenario planned from a cold start.

    Raises:
        InputError: if it has no window, or a burn breaks a rule of the schedule.
    """
    mission = Mission.from_scenario(load_scenario(None, overrides))
    return mission, plan(mission, initial_guess.cold(mission))
