"""Run the four campaigns of `examples/studies`, and sum up what a designer reads from them.

Each is run into OUT/NAME, where an earlier run's cases count. OUT/campaigns.csv has a row for each
campaign, the other files one for each latitude, error or size: how many cases have a verified plan,
what these cost, their lowest probability, and why the others have none. It needs the extras
[campaign] and [report]; the map takes most of an hour.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from experiments.evidence import ROOT
from experiments.harness import Findings, Record, Session, Study, number, option, records
from scp_recon.api.campaigns import campaign
from scp_recon.campaigns.results import VERIFIED
from scp_recon.scp.status import Status

STUDIES = ROOT / "examples" / "studies"
BANDS = {"above 70 N": 70.0, "30 to 70 N": 30.0, "0 to 30 N": 0.0, "0 to 40 S": -40.0}
BANDS |= {"40 to 70 S": -70.0, "beyond 70 S": -90.0}
"""Least latitude of each, deg."""
COMMONEST = 3


def latitude(case: Record) -> str:
    """The band of a site."""
    return next(band for band, least in BANDS.items() if case["site.latitude_deg"] >= least)


def size(case: Record) -> str:
    """Largest burn and least radius."""
    return f"{case['burns.dv_max_m_s']:g} {case['safety.radius_min_m']:g}"


SUMMED: Mapping[str, tuple[str, Callable[[Record], str]]] = {
    "sizes": ("sizes", size),
    "asteroid_year": ("year", lambda _: "all"),
    "errors": ("errors", lambda case: f"{case['uncertainty.execution_error']:.3g}"),
    "reconnaissance_map": ("latitudes", latitude),
}
"""Of each campaign the name of its summary, and what it is summed up by."""
PICTURES = {
    "reconnaissance_map/map": "studies_map",
    "reconnaissance_map/globe": "studies_globe",
    "errors/curves": "studies_errors",
    "asteroid_year/curves": "studies_year",
    "sizes/curves": "studies_sizes",
}


def feasible(case: Record) -> bool:
    """Whether it has a verified plan."""
    return case["status"] == Status.CONVERGED.value.name and case["verdict"] == VERIFIED


def summary(cases: list[Record]) -> Record:
    """Figures of some cases."""
    solved = [case for case in cases if feasible(case)]
    why = [reason(case) for case in cases if not feasible(case)]
    common = sorted(set(why), key=lambda words: (-why.count(words), words))[:COMMONEST]
    row: Record = {"cases": len(cases), "feasible": len(solved)}
    for name, column in (("dv_m_s", "total_dv_m_s"), ("probability", "probability")):
        values = [case[column] for case in solved]
        row |= {f"{name}_min": min(values, default=None), f"{name}_max": max(values, default=None)}
    return row | {"why_not": "; ".join(f"{words} ({why.count(words)})" for words in common)}


def reason(case: Record) -> str:
    """Why a case has no verified plan."""
    if case["status"] == Status.CONVERGED.value.name:
        return "not verified"
    if case["status"] == Status.INFEASIBLE.value.name:
        return str(case["binds"]).replace("_", " ")
    return str(case["status"]).replace("_", " ")


def median(values: list[float]) -> float | None:
    """The middle one, of an even number the upper; None of none."""
    return sorted(values)[len(values) // 2] if values else None


def run(session: Session) -> Findings:
    """Run every campaign, and sum it up."""
    files, totals = dict[str, list[Record]](), []
    for name, (key, by) in SUMMED.items():
        session.say(f"{name}:")
        path = STUDIES / f"{name}.toml"
        table = campaign(path, session.out / name, workers=session.options.workers).table
        cases: list[Record] = table.to_dict("records")
        groups: dict[str, list[Record]] = {}
        for case in cases:
            groups.setdefault(by(case), []).append(case)
        files[key] = [{"of": words} | summary(group) for words, group in groups.items()]
        seconds: dict[str, Any] = {
            f"processor_s_{words}": median([c["cpu_s"] for c in cases if feasible(c) == end])
            for words, end in (("feasible", True), ("other", False))
        }
        total = {"processor_s": sum(case["cpu_s"] for case in cases)}
        totals.append({"campaign": name} | summary(cases) | seconds | total)
    if session.options.pictures:
        for source, target in PICTURES.items():
            shutil.copy(session.out / f"{source}.png", session.options.pictures / f"{target}.png")
    files = {"campaigns": totals} | files
    return Findings([], {f"{name}.csv": records(rows) for name, rows in files.items()})


STUDY = Study(
    "Campaigns summed up",
    __doc__,
    run,
    [
        number("--workers", 1, 0, 256, "processes"),
        option("--pictures", type=Path, metavar="DIR", help="copy maps and curves to this folder"),
    ],
)
