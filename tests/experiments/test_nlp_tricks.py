"""The table of tricks: from the printed program to the tuned one, each measured at the same optimum."""

from __future__ import annotations

from experiments.nlp_tricks import measuring, tricks
from formulations.nlp.solve import VARIANTS
from scp_recon.mission.mission import Mission


def test_the_ladder_leads_from_the_printed_program_to_the_tuned_one() -> None:
    variants = tricks()
    assert next(iter(variants.values())) is VARIANTS["printed"]
    assert variants["+ derivatives arc by arc = tuned"] is VARIANTS["tuned"]
    assert variants["single shooting, L-BFGS = shooting"] == VARIANTS["shooting"]


def test_a_row_holds_what_ipopt_did(mission: Mission) -> None:
    chosen = {k: v for k, v in tricks().items() if k.endswith(("= tuned", "= shooting"))}
    tuned, shooting = map(measuring(mission, chosen), chosen)
    assert shooting["status"] == "converged (Solve_Succeeded)"
    assert shooting["unknowns"] == "12"
    # Two transcriptions of one problem.
    assert shooting["delta-v m/s"] == tuned["delta-v m/s"]
    assert float(shooting["processor s"]) > 0.0
