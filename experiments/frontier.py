"""Measure delta-v against the required probability.

The default scenario is planned for probabilities from 0.55 to 0.999: with the paper's risk split
(uniform risk on its polytopes, and on tangent spheres with 12-facet cones), with exact risk per
node and for whole flights, and certified by flights. Every plan is flown 10,000 times.
OUT/frontier.csv has a row for each: its cost, the probability reached, the expected observation
time, the processor time of all rounds, and the extra delta-v and time of certifying.
`python -m paper_figs frontier` draws them. After Ctrl-C the study
continues with the missing rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from time import process_time
from typing import Any

from experiments.harness import Findings, Record, Session, Study, fly_plan, option, records
from scp_recon.api.planning import plan
from scp_recon.jobs.job import Job
from scp_recon.monte_carlo.flights import FlightTally
from scp_recon.monte_carlo.observation_time import ALL
from scp_recon.planning.plan import Plan
from scp_recon.results.table import Column, Table, Value
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.status import Status

PROBABILITIES = (0.55, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999)
QUICK = (0.7, 0.9)
FLIGHTS, QUICK_FLIGHTS, SEED = 10_000, 100, 20

TANGENT = {"polytopes.ball": "tangent", "polytopes.cone": 12}
EXACT = {"risk.allocation": "exact"}
KINDS: Mapping[str, tuple[dict[str, Any], bool | None]] = {
    "uniform, paper polytopes": ({}, None),
    "uniform, tangent spheres": (TANGENT, None),
    "exact, each node": (EXACT, False),
    "exact, whole flights": (EXACT | {"risk.scope": "flight"}, False),
    "certified, each node": (EXACT, True),
    "certified, whole flights": (EXACT | {"risk.scope": "flight"}, True),
}
"""Changes to the scenario, and of exact risk whether flights certify the plan."""
NOT_CERTIFIED = "not certified"
"""Status of a converged plan whose flights do not reach the required probability."""

AIMED = {
    "certified, each node": "exact, each node",
    "certified, whole flights": "exact, whole flights",
}
"""The kind with which a certified one is compared: the same problem without certifying."""


def measure(flights: int, case: tuple[str, float]) -> Record:
    """Plan one kind for one probability from a cold start, and fly it: a row."""
    kind, p = case
    changes, certified = KINDS[kind]
    scenario = load_scenario().replace({**changes, "risk.p_chance": p})
    begin = process_time()
    found = plan(scenario, certify=certified)
    took = process_time() - begin
    return record(kind, p, found, fly_plan(found, flights, SEED), took)


def with_costs(rows: Sequence[Record]) -> list[Record]:
    """Rows with the extra cost of certifying over planning for the probability itself; else NaN."""
    found = {(row["kind"], row["asked"]): row for row in rows}
    keys = {"certifying_dv_m_s": "total_dv_m_s", "certifying_processor_s": "processor_s"}
    nothing = dict.fromkeys(keys.values(), float("nan"))
    result = []
    for row in rows:
        aimed = found.get((AIMED.get(row["kind"], ""), row["asked"]), nothing)
        result.append(row | {key: row[cost] - aimed[cost] for key, cost in keys.items()})
    return result


def record(kind: str, p: float, found: Plan, flown: FlightTally, processor_s: float) -> Record:
    """A row of a plan's cost and the probability its flights reach; the time is of all its rounds."""
    node = min(flown.worst_probability(name)[1].value for name in flown.node_counts if name != ALL)
    reached = found.certificate
    converged = found.status is Status.CONVERGED
    missed = converged and reached is not None and not reached.certifies(p)
    return {
        "kind": kind,
        "asked": p,
        "status": NOT_CERTIFIED if missed else found.status.value.name,
        "total_dv_m_s": found.total_dv_m_s if converged and not missed else float("nan"),
        "aim": found.target or float("nan"),
        "certified_low": reached.low if reached and converged else float("nan"),
        "node": node if converged else float("nan"),
        "whole_flight": flown.whole / flown.samples if converged else float("nan"),
        "observed_mean_s": flown.held[ALL].mean().value if converged else float("nan"),
        "rounds": reached.rounds if reached else 1,
        "processor_s": processor_s,
    }


def costs(rows: Sequence[Record]) -> Table:
    """Delta-v by kind and probability."""
    required = list(dict.fromkeys(row["asked"] for row in rows))
    cells = {(row["kind"], row["asked"]): row for row in rows}
    by_kind = [
        (kind, *(_dv(cells[kind, p]) for p in required if (kind, p) in cells))
        for kind in dict.fromkeys(str(row["kind"]) for row in rows)
    ]
    return Table.of("", ("delta-v (m/s) for", *(f"{p:g}" for p in required)), by_kind)


def certifying(rows: Sequence[Record]) -> Table:
    """What certifying costs beside a plan for the probability itself."""
    columns: dict[str, Column | str] = {
        "kind": "plan",
        "asked": "required",
        "rounds": "rounds",
        "certifying_dv_m_s": Column("delta-v", "m/s", name="delta_v_m_s"),
        "percent": Column("of it", "%", name="of_it"),
        "processor_s": Column("processor", "s", name="processor_s"),
        "alone_s": Column("by itself", "s", name="by_itself_s"),
    }
    certified = [row | _alone(row) for row in rows if row["kind"] in AIMED]
    lines = [[row[key] for key in columns] for row in certified]
    return Table.of("", [*columns.values()], lines)


def _alone(row: Record) -> Record:
    """The row planned for the probability itself; figures are NaN if either has not converged."""
    more, cost = row["certifying_dv_m_s"], row["total_dv_m_s"]
    return {
        "percent": 100.0 * more / (cost - more),
        "alone_s": row["processor_s"] - row["certifying_processor_s"],
    }


def _dv(row: Record) -> Value:
    converged = row["status"] == Status.CONVERGED.value.name
    return row["total_dv_m_s"] if converged else row["status"]


def run(session: Session) -> Findings:
    """Plan and fly every kind for every probability."""
    probabilities, flights = (
        (QUICK, QUICK_FLIGHTS) if session.options.quick else (PROBABILITIES, FLIGHTS)
    )
    jobs = [Job(f"{kind} {p:g}", (kind, p)) for kind in KINDS for p in probabilities]
    store = session.store(flights=flights)
    rows = with_costs(session.rows("plans", partial(measure, flights), jobs, store, line=_line))
    return Findings(
        {
            "frontier.csv": records(rows),
            "costs.csv": costs(rows),
            "extra_cost_of_certifying.csv": certifying(rows),
        }
    )


def _line(row: Record) -> str:
    return f"{row['kind']}, {row['asked']:g}: {row['status']}, {row['total_dv_m_s']:.5f} m/s"


STUDY = Study(
    __doc__,
    run,
    [
        option(
            "--quick",
            action="store_true",
            help=f"{len(QUICK)} probabilities and {QUICK_FLIGHTS} flights, to see that it runs",
        )
    ],
)
