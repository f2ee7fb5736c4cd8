"""Run five campaigns of `examples/studies`, and summarise them for a designer.

Each campaign runs into OUT/NAME, and keeps the cases of an earlier run. OUT/campaigns.csv has a row
for each campaign, the other files one for each latitude, error or size: the number of cases with a
verified plan, their cost and lowest probability, and why the others have no plan. It needs the
extras [campaign] and [report]; the map takes most of an hour.

With `--sample` a seeded sample of the map's sites is planned instead, for 0.90 of whole flights
with exact risk: OUT/sample.csv has a row for each site, OUT/sample_latitudes.csv one for each
latitude. The cheapest passes without uncertainty, at most `PASSES`, are planned open loop. If none
has a plan, they are planned with feedback. Each is planned once, by the normal law. Flights measure
the probability of the first plan, and certify nothing. After Ctrl-C it continues with the missing
sites.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from time import process_time
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from experiments.evidence import ROOT
from experiments.harness import Record, Session, Tables, fly_plan
from experiments.harness import Study as Harnessed
from experiments.plans import measured
from scp_recon.api.verbs import campaign
from scp_recon.campaigns.axes import changed
from scp_recon.campaigns.run import VERIFIED
from scp_recon.campaigns.study import Study, read_study
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.summary import MOST
from scp_recon.passes.design import Designer
from scp_recon.passes.space import settled, spaces_of
from scp_recon.passes.timing import PassResult
from scp_recon.planning.initial_guess import from_burns
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import Planner
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status

Case: TypeAlias = Mapping[str, Any]
CAMPAIGNS = ROOT / "examples" / "studies"
LATITUDE = "site.latitude_deg"
BANDS = {"above 70 N": 70.0, "30 to 70 N": 30.0, "0 to 30 N": 0.0, "0 to 40 S": -40.0}
BANDS |= {"40 to 70 S": -70.0, "beyond 70 S": -90.0}
"""Least latitude of each, deg."""
COMMONEST = 3


def latitude(case: Case) -> str:
    """The band of a site."""
    return next(band for band, least in BANDS.items() if case[LATITUDE] >= least)


def size(case: Case) -> str:
    """Largest burn and least radius."""
    return f"{case['burns.dv_max_m_s']:g} {case['safety.radius_min_m']:g}"


SUMMED: Mapping[str, tuple[str, Callable[[Case], str]] | None] = {
    "sizes": ("sizes", size),
    "asteroid_year": None,
    "errors": ("errors", lambda case: f"{case['uncertainty.execution_error']:.3g}"),
    "reconnaissance_map": ("latitudes", latitude),
    "ryugu_map": ("ryugu_latitudes", latitude),
}
"""Name of each campaign's summary, and the function that sums it up."""


def feasible(cases: pd.DataFrame) -> pd.Series:
    """Which cases have a verified plan."""
    return (cases.status == Status.CONVERGED.value.name) & (cases.verdict == VERIFIED)


def summary(cases: pd.DataFrame) -> Record:
    """Figures of some cases."""
    solved = feasible(cases)
    why = cases.status.where(cases.status != Status.INFEASIBLE.value.name, cases.get("binds"))
    why = why.replace({Status.CONVERGED.value.name: "not verified"}).str.replace("_", " ")
    common = sorted(why[~solved].value_counts().items(), key=lambda one: (-one[1], one[0]))
    row: Record = {"cases": len(cases), "feasible": int(solved.sum())}
    for name, column in (("dv_m_s", "total_dv_m_s"), ("probability", "probability")):
        row |= extremes(name, cases[solved], column)
    return row | {"why_not": "; ".join(f"{words} ({n})" for words, n in common[:COMMONEST])}


def extremes(name: str, cases: pd.DataFrame, column: str) -> Record:
    """Least and largest value of a column; NaN without a case."""
    values = cases.get(column, pd.Series(dtype=float))
    return {f"{name}_min": values.min(), f"{name}_max": values.max()}


SAMPLE, SEED, FLIGHTS = 60, 0, 2_000
PASSES = 2
"""Passes of a site that are planned."""
ASKED = {"risk.allocation": "exact", "risk.scope": "flight", "risk.p_chance": 0.9}


@cache
def sites() -> Study:
    """The campaign of the map."""
    return read_study(CAMPAIGNS / "reconnaissance_map.toml")


def sampled(number: int) -> Record:
    """A site of the map, open loop and with feedback: a row."""
    begin, case = process_time(), sites().cases[number]
    row = {entry: case.changes[entry] for entry in ("site.name", LATITUDE, "site.longitude_deg")}
    scenario = changed(sites().base, case.changes, sites().folder).replace(ASKED | measured())
    try:
        space = spaces_of(scenario)[0]
    except InputError as error:
        return row | {"open": False, "corrected": False, "why": str(error.given)}
    passes = [one for one in Designer(scenario, lambda _: None).certain(space) if one.converged]
    for name, policy in (("open", "open"), ("corrected", "feedback")):
        plans = (planned(scenario, one, policy) for one in passes[:PASSES])
        found = next((one for one in plans if one.status is Status.CONVERGED), None)
        if found is not None:
            flown = fly_plan(found, FLIGHTS, SEED)
            row |= {"open": name == "open", "corrected": True, "total_dv_m_s": found.total_dv_m_s}
            row |= {"dv99_m_s": flown.tallies["commanded_dv_m_s"].quantile(MOST)[0]}
            row |= {"whole_flight": flown.whole / flown.samples}
            break
    else:
        row |= {"open": False, "corrected": False, "why": "infeasible" if passes else "no pass"}
    return row | {"processor_s": process_time() - begin}


def planned(scenario: Scenario, one: PassResult, policy: str) -> Plan:
    """A pass planned once by a policy."""
    fixed = settled(scenario, one.space, one.at).replace({"policy.kind": policy})
    mission = Mission.from_scenario(fixed)
    return Planner(mission).plan(from_burns(mission, one.burns_m_s), once=True)


def run_sample(session: Session) -> Tables:
    """Plan the sampled sites."""
    rows = session.rows("sites", sampled, drawn_numbers())
    found = pd.DataFrame(rows)
    bands = found.apply(latitude, axis=1)
    own = {band: found[bands == band] for band in BANDS} | {"all": found}
    sums = [{"of": band, **counted(some)} for band, some in own.items() if len(some)]
    return {"sample": rows, "sample_latitudes": sums}


def drawn_numbers() -> list[int]:
    """Numbers of the sample's cases."""
    drawn = np.random.default_rng(SEED).choice(len(sites().cases), SAMPLE, replace=False)
    return sorted(int(number) for number in drawn)


def counted(rows: pd.DataFrame) -> Record:
    """How many sites have a plan open loop, how many more with feedback, and what these cost."""
    row: Record = {"sites": len(rows)}
    for name, own in (("open", rows[rows.open]), ("more", rows[rows.corrected & ~rows.open])):
        for column in ("dv99_m_s", "whole_flight"):
            row |= extremes(f"{name}_{column}", own, column)
        row[name] = len(own)
    return row


def run(session: Session) -> Tables:
    """Run every campaign, and sum it up; or plan the sample."""
    if session.options.sample:
        return run_sample(session)
    tables: dict[str, list[Record]] = {"campaigns": []}
    for name, summed in SUMMED.items():
        session.say(f"{name}:")
        cases = campaign(CAMPAIGNS / f"{name}.toml", session.out / name).table
        row, solved = {"campaign": name, **summary(cases)}, feasible(cases)
        for words, own in (("feasible", cases[solved]), ("other", cases[~solved])):
            row[f"processor_s_{words}"] = own.cpu_s.quantile(0.5, "higher")
        tables["campaigns"].append(row | {"processor_s": cases.cpu_s.sum()})
        if summed is not None:
            key, by = summed
            groups = cases.groupby(cases.apply(by, axis=1), sort=False)
            tables[key] = [{"of": words} | summary(group) for words, group in groups]
            if by is latitude:
                tables[key].sort(key=lambda row: [*BANDS].index(row["of"]))
    return tables


SAMPLED = {"action": "store_true", "help": "a sample of the map's sites, with feedback"}
STUDIES = {"maps": Harnessed(__doc__, run, {"--sample": SAMPLED})}
