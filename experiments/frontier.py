"""What probability costs: `python -m experiments.frontier`.

The default scenario planned for probabilities from 0.55 to 0.999, with the paper's bookkeeping (uniform
risk on its polytopes, and on tangent spheres with 12-facet cones), with exact risk per node and for
whole flights, and with flights that certify it. Every plan is flown 10,000 times. OUT/frontier.csv has
a row for each: what it costs and reaches, the expected observation time, the processor's seconds of all
rounds, and what certifying costs more than aiming at the probability itself, in delta-v and in seconds.
OUT/frontier.md has the tables; `paper_figs.studies.frontier` draws them. What was found before Ctrl-C
is kept and taken up.
"""

from __future__ import annotations

from scp_recon.cli.command import exit_on_sigint, parse

if __name__ == "__main__":
    exit_on_sigint()

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

from experiments.kept import Kept
from experiments.studies import Cell, add_out, markdown, run, to_csv
from scp_recon.certification.certify import certify
from scp_recon.files import write_atomically
from scp_recon.mission.mission import Mission
from scp_recon.monte_carlo.flights import FlightConfig, fly_many
from scp_recon.monte_carlo.observation_time import ALL
from scp_recon.planning import initial_guess
from scp_recon.planning.plan import Plan
from scp_recon.planning.planner import plan
from scp_recon.scenario.load import load_scenario
from scp_recon.scenario.schema import Scenario
from scp_recon.scp.status import Status

NAME = "frontier"
DEFAULT_OUT = Path("runs") / NAME
PROBABILITIES = (0.55, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999)
QUICK = (0.7, 0.9)
FLIGHTS, QUICK_FLIGHTS, SEED = 10_000, 100, 20

TANGENT = {"polytopes.ball": "tangent", "polytopes.cone": 12}
EXACT = {"risk.allocation": "exact"}
KINDS: Mapping[str, tuple[dict[str, Any], bool]] = {
    "uniform, paper polytopes": ({}, False),
    "uniform, tangent spheres": (TANGENT, False),
    "exact, each node": (EXACT, False),
    "exact, whole flights": (EXACT | {"risk.scope": "flight"}, False),
    "certified, each node": (EXACT, True),
    "certified, whole flights": (EXACT | {"risk.scope": "flight"}, True),
}
"""Changes to the scenario, and whether flights certify the plan."""
NOT_CERTIFIED = "not certified"
"""Status of a plan that has converged, of which flights reach less than was asked."""

AIMED = {
    "certified, each node": "exact, each node",
    "certified, whole flights": "exact, whole flights",
}
"""The kind that a certified one is held against: the same problem, aiming at the probability itself."""


def planned(scenario: Scenario, *, certified: bool) -> Plan:
    """A cold plan."""
    mission = Mission.from_scenario(scenario)
    start = initial_guess.cold(mission)
    if not certified:
        return plan(mission, start)
    return certify(mission, start, lambda m, s, aim: plan(m, s, aim=aim))


def study(probabilities: Sequence[float], flights: int, kept: Kept) -> Iterator[dict[str, Cell]]:
    """A row for each kind of plan and probability; those that are kept are not made again."""
    base = load_scenario()
    found: dict[tuple[str, float], Mapping[str, Cell]] = {}
    for kind, (changes, certified) in KINDS.items():
        for p in probabilities:
            scenario = base.replace({**changes, "risk.p_chance": p})
            row = kept.row(
                f"{kind} {p:g}",
                partial(_row, kind, p, scenario, certified, flights),
            )
            found[kind, p] = row
            yield row | certifying_costs(row, found.get((AIMED.get(kind, ""), p)))


def certifying_costs(row: Mapping[str, Cell], aimed: Mapping[str, Cell] | None) -> dict[str, Cell]:
    """What a certified plan costs more than one that aims at the probability itself; NaN of others."""
    keys = {"certifying_dv_m_s": "total_dv_m_s", "certifying_processor_s": "processor_s"}
    if aimed is None:
        return dict.fromkeys(keys, float("nan"))
    return {key: float(row[cost]) - float(aimed[cost]) for key, cost in keys.items()}


def _row(kind: str, p: float, scenario: Scenario, certified: bool, flights: int) -> dict[str, Cell]:
    begin = process_time()
    found = planned(scenario, certified=certified)
    return record(kind, p, found, flights, process_time() - begin)


def record(kind: str, p: float, found: Plan, flights: int, processor_s: float) -> dict[str, Cell]:
    """What a plan costs, and what its flights reach; the time is that of all its rounds."""
    flown = fly_many(FlightConfig(found.mission, found.burns_m_s, SEED), samples=flights)
    node = min(flown.worst_probability(name)[1].value for name in flown.node_counts if name != ALL)
    reached = found.certificate
    converged = found.status is Status.CONVERGED
    missed = converged and reached is not None and reached.low < p
    return {
        "kind": kind,
        "asked": p,
        "status": NOT_CERTIFIED if missed else found.status.value.name,
        "total_dv_m_s": found.total_dv_m_s if converged and not missed else float("nan"),
        "aim": found.aim or float("nan"),
        "certified_low": reached.low if reached and converged else float("nan"),
        "node": node if converged else float("nan"),
        "whole_flight": flown.whole / flown.samples if converged else float("nan"),
        "observed_mean_s": flown.held[ALL].mean().value if converged else float("nan"),
        "rounds": reached.rounds if reached else 1,
        "processor_s": processor_s,
    }


def to_markdown(rows: Sequence[Mapping[str, Cell]], flights: int) -> str:
    """Delta-v by kind and probability, and what the sentence in the README rests on."""
    asked = list(dict.fromkeys(float(row["asked"]) for row in rows))
    cells = {(row["kind"], row["asked"]): row for row in rows}
    lines = [(kind, *(_dv(cells[kind, p]) for p in asked if (kind, p) in cells)) for kind in KINDS]
    header = ("delta-v (m/s) for", *(f"{p:g}" for p in asked))
    flown = [
        (
            str(row["kind"]),
            f"{row['asked']:g}",
            *(f"{float(row[key]):.4f}" for key in ("node", "whole_flight")),
            f"{float(row['observed_mean_s']):.0f}",
        )
        for row in rows
        if row["status"] == Status.CONVERGED.value.name
    ]
    names = ("plan", "asked", "lowest node", "whole flights", "mean time observed (s)")
    note = f"{flights} flights each, looked at every minute and at the nodes."
    parts = ["# What probability costs", markdown(header, lines), note, markdown(names, flown)]
    certified = [_certifying(row) for row in rows if row["kind"] in AIMED]
    if certified:
        parts.append("What certifying costs more than aiming at the probability itself:")
        head = (
            "plan",
            "asked",
            "rounds",
            "delta-v (m/s)",
            "of it",
            "processor (s)",
            "by itself (s)",
        )
        parts.append(markdown(head, certified))
    return "\n\n".join(parts) + "\n"


def _certifying(row: Mapping[str, Cell]) -> tuple[str, ...]:
    """A line of the table of certified plans; NaN where either plan has not converged."""
    more, cost = float(row["certifying_dv_m_s"]), float(row["total_dv_m_s"])
    seconds = float(row["processor_s"])
    return (
        str(row["kind"]),
        f"{row['asked']:g}",
        str(row["rounds"]),
        f"{more:+.5f}",
        f"{100.0 * more / (cost - more):+.2f} %",
        f"{seconds:.1f}",
        f"{seconds - float(row['certifying_processor_s']):.1f}",
    )


def _dv(row: Mapping[str, Cell]) -> str:
    return (
        f"{float(row['total_dv_m_s']):.5f}"
        if row["status"] == Status.CONVERGED.value.name
        else str(row["status"])
    )


def parser() -> argparse.ArgumentParser:
    """The command line."""
    p = argparse.ArgumentParser(prog=f"python -m experiments.{NAME}", description=__doc__)
    add_out(p, DEFAULT_OUT)
    p.add_argument(
        "--quick",
        action="store_true",
        help=f"{len(QUICK)} probabilities and {QUICK_FLIGHTS} flights, to see that it runs",
    )
    return p


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 if everything was written, 2 for bad input."""
    return run(_run, parse(parser(), arguments))


def _run(options: argparse.Namespace) -> int:
    probabilities = QUICK if options.quick else PROBABILITIES
    flights = QUICK_FLIGHTS if options.quick else FLIGHTS
    options.out.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Cell]] = []
    kept = Kept(options.out / f"{NAME}_partial.jsonl", __file__, {"flights": flights})
    for row in study(probabilities, flights, kept):
        print(
            f"{row['kind']}, {row['asked']:g}: {row['status']}, {float(row['total_dv_m_s']):.5f} m/s"
        )
        rows.append(row)
        write_atomically(options.out / f"{NAME}.csv", to_csv(rows))
    path = write_atomically(options.out / f"{NAME}.md", to_markdown(rows, flights))
    kept.forget()
    print(f"written: {options.out / NAME}.csv\nwritten: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
