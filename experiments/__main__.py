"""Run a study by its name, `python -m experiments NAME [options]`; without a name list them."""

from __future__ import annotations

import os

from scp_recon.cli.command import exit_on_sigint

if __name__ == "__main__":
    exit_on_sigint()
    # NumPy's threads wait for each other in busy loops, which a study would count.
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

import sys
from collections.abc import Sequence

from rich.console import Console

from experiments.harness import run, study_of
from scp_recon.cli.command import run_command, show_line
from scp_recon.errors import one_of

STUDIES = {
    "observation_table": "the paper's table of observation times",
    "plans": "the plans, and with --designs the passes, that the pages quote",
    "gallery": "passes over packaged bodies, designed, certified and flown",
    "frontier": "delta-v against the required probability, and the cost of certifying",
    "feedback": "what feedback is worth, beside open loop and targeting gains",
    "policies": "burns as planned, corrected by gains, and planned again before each",
    "sites": "how likely sites out of reach are seen with feedback, by navigation and lead",
    "compare_solvers": "forms, algorithms and conic solvers against IPOPT",
    "accuracy": "how near the optimum each method is after how many seconds",
    "lifted": "sizes and times of P2 in its lifted and its condensed form",
    "sensitivity": "penalty weight, first radius and dynamics weight, varied one at a time",
    "nlp_tricks": "what each trick gains the nonlinear program",
    "peers": "the planner beside scocp and OpenSCvx",
    "model_fidelity": "how good a model of forces and burns the planner needs",
    "battery_cones": "where the panels cannot carry the load",
    "uncertainty_sources": "what each source of uncertainty does to the flight",
    "timing_rules": "the schedule's durations, measured on the spacecraft",
    "maps": "the campaigns of examples/studies, summed up",
    "testing": "reliability, coverage and mutation: what the tests reach",
    "spice": "the default plan's geometry by SPICE from its kernels",
    "cross_check": "the default plan flown by Orekit and brahe",
    "flown_plan": "whether the spacecraft can fly a plan",
    "flown_policies": "policies flown by the spacecraft: as planned, by gains, planned again",
}
"""The studies, and what each is about."""
RENEW = "evidence"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a study by name; returns 0 or the study's exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    name = words[0] if words else "--help"
    if name in ("-h", "--help"):
        return run_command(_list_them)
    if name == RENEW:
        from experiments import renewal  # which imports all studies

        return renewal.main(words[1:])
    if name not in STUDIES:
        return run_command(lambda _: int(one_of("NAME", name, STUDIES)))
    return run(f"python -m experiments {name}", study_of(name), words[1:])


def _list_them(console: Console) -> int:
    show_line(console, "usage: python -m experiments NAME [options]; NAME is one of\n")
    renewal = "what is out of date of all these that the pages show"
    for name, about in {**STUDIES, RENEW: renewal}.items():
        show_line(console, f"  {name:20} {about}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
