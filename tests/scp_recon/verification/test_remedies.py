"""Every check that can fail has one line that says what to do, the same wherever it is shown."""

from __future__ import annotations

from dataclasses import replace

from scp_recon.mission.mission import Mission
from scp_recon.results.facts import BurnLimit, Verification
from scp_recon.results.figures import FINAL_SIGMAS
from scp_recon.results.solution import HASH, Solution
from scp_recon.scp.status import Status
from scp_recon.verification.remedies import REMEDIES, kind_of, what_next


def failing(verification: Verification, *names: str, **figures: float) -> Verification:
    return replace(verification, **figures, failed=list(names), ok=False)  # type: ignore[arg-type]


def test_every_check_has_a_remedy(mission: Mission, verification: Verification) -> None:
    """By its kind; a probability or a margin by where it is missed."""
    v = verification
    between = replace(v.mean_margins[-1], worst_t_s=float(mission.times_s[:2].mean()))
    v = replace(v, mean_margins=[*v.mean_margins[:-1], between])
    v = replace(v, burn_limits=(BurnLimit(2, "dv_max", 8000.0, 0.5),))
    at_nodes = [p for p in v.probabilities if min(abs(mission.times_s - p.worst_t_s)) < 1.0]
    found = {
        "status": {"status"},
        "certificate": {"certificate"},
        "grid": {"covariance_error", "max_defect", "sample_error_m", "terminal_position_error_m"},
        "between nodes": {between.name},
        "short": {f"P({p.name})" for p in at_nodes},
        "burns": {"dv_max"},
        "spread": {name for name, _, _ in FINAL_SIGMAS},
        "commands": {"P(dv_max of burn 2)"},
        "contradiction": {HASH, "facets", "violation", "nodes.t_s", "risk", "total_dv_m_s"},
    }
    assert found.keys() == REMEDIES.keys()
    for kind, names in found.items():
        assert names
        assert {kind_of(name, mission, v) for name in names} == {kind}


def test_it_says_how_fine_a_grid_is_enough(
    mission: Mission, solution: Solution, verification: Verification
) -> None:
    """At fourth order: half the limit of covariances that err by 17 times it at 232 s."""
    failed = failing(verification, "covariance_error", covariance_error=1.7e-5)
    (line,) = what_next(mission, solution, failed)
    assert line.startswith("covariance_error: integration errs: set grid.step_max_s=94,")
    edited = failing(verification, "covariance_error", covariance_error=0.5)
    (line,) = what_next(mission, solution, edited)
    assert line == f"covariance_error: {REMEDIES['contradiction']}"


def test_a_plan_that_has_not_converged_has_the_remedy_of_its_status(
    mission: Mission, solution: Solution, verification: Verification
) -> None:
    stalled = replace(solution, status=Status.STALLED.value.name)
    failed = failing(verification, "status", "P(emission)", "emission_max")
    (line,) = what_next(mission, stalled, failed)
    assert line == f"status, P(emission), emission_max: {Status.STALLED.value.remedy}"
