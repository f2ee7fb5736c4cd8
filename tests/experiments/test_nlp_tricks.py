"""The table of tricks: from the printed program to the tuned one, each measured at the same optimum."""

from __future__ import annotations

from pathlib import Path

from experiments import nlp_tricks
from experiments.kept import Kept
from experiments.nlp_tricks import HEAD, measure, to_csv, to_markdown, tricks
from formulations.nlp.solve import VARIANTS
from scp_recon.mission.mission import Mission


def kept(folder: Path) -> Kept:
    return Kept(folder / "partial.jsonl", nlp_tricks.__file__, {})


def test_the_ladder_leads_from_the_printed_program_to_the_tuned_one() -> None:
    variants = {trick.name: trick.variant for trick in tricks()}
    assert next(iter(variants.values())) is VARIANTS["printed"]
    assert variants["+ derivatives arc by arc = tuned"] is VARIANTS["tuned"]
    assert variants["single shooting, L-BFGS = shooting"] == VARIANTS["shooting"]
    assert len(variants) == len(tricks())


def test_a_row_holds_what_ipopt_did_and_is_kept(mission: Mission, tmp_path: Path) -> None:
    chosen = [trick for trick in tricks() if trick.name.endswith(("= tuned", "= shooting"))]
    told: list[str] = []
    tuned, shooting = measure(mission, chosen, kept(tmp_path), told.append)
    assert measure(mission, chosen, kept(tmp_path), told.append) == [tuned, shooting]
    figures = dict(zip(HEAD, shooting, strict=True))
    assert figures["status"] == "converged (Solve_Succeeded)"
    assert figures["unknowns"] == "12"
    # Two transcriptions of one problem.
    assert figures["delta-v m/s"] == tuned[HEAD.index("delta-v m/s")]
    assert float(figures["processor s"]) > 0.0
    assert told[2:] == told[:2]  # to the hundredth of a second: nothing was solved again
    assert to_csv([tuned, shooting]).count("\n") == to_markdown([tuned]).count("\n") == 3
