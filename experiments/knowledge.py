"""Measure which uncertain parameters of body, site and spacecraft matter, and what they cost.

Each case is a scenario with what was known of its body at a time, to 1 sigma, with the source of each
number. OUT/parameters.csv has a row for each parameter: the share of flights that keep all limits of
the plan that knows everything, where that parameter alone is uncertain. OUT/plans.csv has a row for
each case: that share with all parameters uncertain, and the plans made with that knowledge, open loop
and with feedback, certified: cost, price over the same plan that knows everything, and share of
flights. Flights are of another seed than the planner's. `python -m paper_figs knowledge` draws both
tables. After Ctrl-C the study continues with the missing rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

from experiments.costs import LEAD_S
from experiments.harness import Record, Session, Study, Tables, fly_plan
from experiments.missed_burns import fixed
from experiments.plans import FLIGHT, measured
from scp_recon.api.verbs import plan
from scp_recon.mission.knowledge import in_words
from scp_recon.monte_carlo.flights import fly_many
from scp_recon.monte_carlo.sampling import Flyer
from scp_recon.planning.plan import Plan
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status

FLIGHTS, SEED = 10_000, 20
ALL = "all of them"
GM_TO = "Bennu, GM to {:.0f} %"
GM_10 = GM_TO.format(10.0)


class Prior(NamedTuple):
    """An entry of the scenario, its 1 sigma in the entry's unit, and where the number is from."""

    entry: str
    sigma: float | list[float]
    source: str


class Case(NamedTuple):
    """A packaged scenario, changes to it, and what was known."""

    scenario: str
    changes: Mapping[str, Any]
    known: Sequence[Prior]


GM, J2 = "body.gm_m3_s2", "body.j2"
RA, DEC = "body.pole_ra_deg", "body.pole_dec_deg"
PHASE, RATE = "body.prime_meridian_deg", "body.prime_meridian_rate_deg_day"
SITE, NORMAL = "site.position_body_m", "site.normal_body"
LIGHT = "spacecraft.reflectivity_coefficient"

CHESLEY = "Chesley et al. 2014, Icarus 235, 5, abstract: GM 5.2 +- 0.6 m^3/s^2"
NOLAN = "Nolan et al. 2013, Icarus 226, 629, {}; the text could not be had"
FOUND = "; it was {} off (bennu_v16.tpc, versions 1.0 and 1.6)"
LAURETTA = "Lauretta et al. 2019, Nature 568, 55, {}; read in Wikipedia, not in the text"
MAKADIA = "Makadia et al. 2026, Science Advances 12, eaea4259, abstract: {} kg/m^3"
RADAR = "the radar shape of constant density has 0.0282 (McMahon et al. 2018)"
DIAMETERS = "assumed: not measured; diameters of 340 to 420 m: A&A 709, A278, introduction"
ASSUMED = "assumed"
BENNU = FLIGHT | {"risk.p_chance": 0.9}


CASES: Mapping[str, Case] = {
    **{
        GM_TO.format(share): Case(
            "recon_b", BENNU, [Prior(GM, 0.0489 * share, f"{share:.0f} % of GM")]
        )
        for share in (1.0, 3.0, 10.0)
    },
    "Bennu before arrival": Case("recon_b", BENNU, [
        Prior(GM, 0.6, CHESLEY),
        Prior(J2, 0.0149, RADAR),
        Prior(RA, 8.0, NOLAN.format("pole to 4 deg") + FOUND.format("1.2 deg")),
        Prior(DEC, 4.0, NOLAN.format("pole to 4 deg") + FOUND.format("4.7 deg")),
        Prior(RATE, 0.94, NOLAN.format("period to 0.002 h") + FOUND.format("0.66 deg/day")),
        Prior(LIGHT, 0.1, ASSUMED),
    ]),
    "Bennu on approach": Case("recon_b", BENNU, [
        Prior(GM, 0.6, CHESLEY),
        Prior(J2, 0.0149, "as before arrival"),
        Prior(RA, 1.0, ASSUMED),
        Prior(DEC, 0.5, ASSUMED),
        Prior(PHASE, 1.0, ASSUMED),
        Prior(SITE, [3.0] * 3, ASSUMED),
        Prior(LIGHT, 0.1, ASSUMED),
    ]),
    "Bennu after Preliminary Survey": Case("recon_b", BENNU, [
        Prior(GM, 0.006, LAURETTA.format("mass 7.329 +- 0.009 10^10 kg")),
        Prior(J2, 0.0011, "the shape of constant density has 0.0419, tracking 0.0431"),
        Prior(RA, 0.12, LAURETTA.format("pole 85.65 +- 0.12 deg")),
        Prior(DEC, 0.09, LAURETTA.format("pole -60.17 +- 0.09 deg")),
        Prior(PHASE, 0.1, ASSUMED),
        Prior(SITE, [1.0] * 3, ASSUMED),
        Prior(LIGHT, 0.05, ASSUMED),
    ]),
    "Bennu today": Case("recon_b", BENNU, [
        Prior(GM, 1e-4, "assumed: two published values differ by 5e-5 (Chesley et al. 2020; JPL)"),
        Prior(J2, 1e-4, ASSUMED),
        Prior(DEC, 0.01, "0.0092 deg between bennu_v15.tpc and v16"),
        Prior(PHASE, 0.065, "W in January 2020 between bennu_v15.tpc and v16"),
        Prior(SITE, [0.2] * 3, ASSUMED),
        Prior(LIGHT, 0.05, ASSUMED),
    ]),
    "Didymos today": Case("didymos", fixed("didymos"), [
        Prior(GM, 1.87, MAKADIA.format("2600 +- 140")),
        Prior("body.companion.gm_m3_s2", 0.0426, MAKADIA.format("1540 +- 220")),
        Prior(J2, 0.012, "radii 394 +- 11 and 290 +- 16 m: Naidu et al. 2024, abstract"),
        Prior("body.companion.mean_anomaly_deg", 2.0, "assumed; unmeasured it grows by 10 deg a year"),
        Prior(SITE, [5.0] * 3, ASSUMED),
        Prior(LIGHT, 0.1, ASSUMED),
    ]),
    "Apophis today": Case("apophis", fixed("apophis"), [
        Prior(GM, 0.5, DIAMETERS),
        Prior(SITE, [6.0] * 3, "assumed: its attitude to 2 deg"),
        Prior(NORMAL, [0.03] * 3, "assumed: its attitude to 2 deg"),
        Prior(LIGHT, 0.1, ASSUMED),
    ]),
}  # fmt: skip
"""What was known of each body at a time."""
POLICIES: Mapping[str, dict[str, Any]] = {"open": {}, "feedback": measured(lead_s=LEAD_S)}


def scenario_of(case: str, known: Sequence[Prior] = (), policy: str = "open") -> Scenario:
    """The scenario of a case with some of its parameters uncertain."""
    name, changes, _ = CASES[case]
    return load_scenario(name).replace({**changes, **POLICIES[policy], **sigmas(known)})


def sigmas(known: Sequence[Prior]) -> dict[str, Any]:
    """Entries of `[knowledge]`."""
    return {f"knowledge.{one.entry}": one.sigma for one in known}


@cache
def _planned(scenario: Scenario) -> Plan:
    return plan(scenario, starts=1, certify=True)


def kept(found: Plan, known: Sequence[Prior]) -> float:
    """Share of a plan's flights that keep all limits, with parameters that the plan takes as known."""
    mission = found.mission.changed(sigmas(known))
    flown = fly_many(Flyer(mission, found.burns_m_s, seed=SEED), samples=FLIGHTS)
    return flown.whole / flown.samples


def planned(case: str, policy: str) -> Record:
    """Columns on the plan with all parameters of a case uncertain, and its price."""
    known = CASES[case].known
    least, found = (_planned(scenario_of(case, of, policy)) for of in ((), known))
    row: Record = {f"{policy}_status": found.status.value.name}
    if found.status is not Status.CONVERGED:
        return row
    flown = fly_plan(found, FLIGHTS, SEED)
    own, other = (
        one.final.result.lin.cost.value * one.mission.units.speed_m_s for one in (found, least)
    )
    return row | {
        f"{policy}_m_s": own,
        f"{policy}_percent": 100.0 * (own / other - 1.0),
        f"{policy}_flown": flown.whole / flown.samples,
    }


def measure(at: tuple[str, str]) -> Record:
    """One parameter of a case alone, or all of them with the plans that know of them: a row."""
    case, entry = at
    known = [one for one in CASES[case].known if entry in (one.entry, ALL)]
    simple = _planned(scenario_of(case))
    row: Record = {"case": case, "parameter": entry, "kept": kept(simple, known)}
    if entry != ALL:
        words = in_words(scenario_of(case, known)).removeprefix(entry).strip()
        return row | {"sigma": words, "source": known[0].source}
    row |= {"least_m_s": simple.total_dv_m_s, "without": kept(simple, [])}
    return row | planned(case, "open") | planned(case, "feedback")


def run(session: Session) -> Tables:
    """Measure every parameter of every case, alone and together."""
    each = [(case, one.entry) for case, of in CASES.items() for one in of.known]
    alone = session.rows("parameters", measure, each)
    together = session.rows("plans", measure, [(case, ALL) for case in CASES])
    return {"parameters": alone, "plans": together}


STUDIES = {"knowledge": Study(__doc__, run)}
