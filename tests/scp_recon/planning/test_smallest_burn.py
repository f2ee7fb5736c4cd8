"""Burns that no thruster can fire are left out or raised, and nothing speaks of those left out."""

from dataclasses import replace

import numpy as np
import pytest

import scp_recon as sr
from scp_recon.interop.ccsds import opm_text
from scp_recon.interop.export import Export
from scp_recon.planning.plan import Plan
from scp_recon.reports.shown import Shown, budget_table
from scp_recon.reports.tables import burns_table, limits_table
from scp_recon.results.facts import Burn
from scp_recon.results.read import read_solution
from scp_recon.results.solution import Solution, make_solution
from scp_recon.scp.status import Status
from scp_recon.verification.reintegration import verify
from tests.helpers import nightly
from tests.scenarios import COARSE

pytestmark = pytest.mark.slow

EXACT = (COARSE, 'risk.allocation="exact"', 'risk.scope="flight"', "risk.p_chance=0.8")


def sizes_of(plan: Plan) -> list[float]:
    return np.linalg.norm(plan.burns_m_s, axis=1).tolist()


@pytest.fixture(scope="module")
def exact() -> Plan:
    """Its third burn has vanished, to 1e-11 m/s where burns may be as small as they like."""
    return sr.plan(certify=False, overrides=EXACT)


@pytest.fixture(scope="module")
def stored(exact) -> Solution:
    return make_solution(exact)


def without_uncertainty(least: float, **options: str) -> Plan:
    return sr.plan(problem="P3", overrides=[f"burns.dv_min_m_s={least}"], **options)  # type: ignore[arg-type]


ALL, RAISED = [0.046599, 0.022518, 0.0, 0.038605], [0.044292, 0.025, 0.0, 0.03866]


@pytest.mark.parametrize(
    ("least", "algorithm", "sizes"),
    [
        (0.0, "scvx", ALL),
        (1e-4, "scvx", ALL),
        (0.025, "scvx", RAISED),  # without burn 2 it would cost 7 mm/s more
        (0.025, "ptr", RAISED),
        (0.04, "scvx", [0.070969, 0.0, 0.0, 0.044315]),  # 0.16 m/s with all of the last three
    ],
)
def test_small_burns_are_left_out_or_raised(least, algorithm, sizes):
    """Each separately, to what is cheapest."""
    plan = without_uncertainty(least, algorithm=algorithm)
    assert sizes_of(plan) == pytest.approx(sizes, abs=2e-6)
    assert all(size == 0.0 or size > least - 1e-7 for size in sizes_of(plan))
    held = [one for one in plan.stages[1:] if one.result.status is Status.CONVERGED]
    assert {one.name for one in held} == ({"P3.held"} if least else set())
    costs = [one.result.lin.iterate.total_dv for one in held or plan.stages]
    assert plan.final.result.lin.iterate.total_dv == min(costs)


@pytest.mark.usefixtures("few_flights")
def test_table_says_that_the_smallest_burn_binds(default_plan, solution, verification):
    raised = without_uncertainty(0.025)
    kept = make_solution(raised)
    rows = [
        [c.text for c in row]
        for row in limits_table(raised.mission, kept, verify(raised.mission, kept)).rows
    ]
    (row,) = (row for row in rows if row[0] == "dv_min")
    assert (row[1:3], row[-2:]) == ([">= 25 mm/s", ">= 25"], ["8000", "binds"])
    free = limits_table(default_plan.mission, solution, verification).rows
    assert "dv_min" not in [row[0].text for row in free]


def test_ipopt_decides_as_scp_does():
    how = {"problem": "P3", "overrides": [COARSE, "burns.dv_min_m_s=0.025"]}
    found, expected = sr.plan(method="ipopt", **how), sr.plan(**how)  # type: ignore[arg-type]
    assert found.status is Status.CONVERGED
    assert sizes_of(found)[2] == 0.0
    assert sizes_of(found) == pytest.approx(sizes_of(expected), abs=1e-7)
    assert found.final.result.lin.is_dynamically_feasible


@nightly
def test_a_raised_burn_stays_at_its_floor():
    """The floor is hard: an iterate below it would leave the next program without a worse answer."""
    plan = sr.plan(overrides=["burns.dv_min_m_s=0.027"])
    assert plan.status is Status.CONVERGED
    assert sizes_of(plan)[1:3] == pytest.approx([0.027, 0.027], abs=1e-7)
    assert plan.mission.warnings == ()


def test_unavoidable_small_burns_stay_with_a_warning(default_plan):
    """Two burns leave no choice: the final state says what they are."""
    at, state = default_plan.times_s[80], default_plan.states[80]
    left = sr.replan(default_plan, at, state, overrides=["burns.dv_min_m_s=0.025"])
    assert left.status is Status.CONVERGED
    assert sizes_of(left)[0] == pytest.approx(0.02365, abs=1e-4)
    (warning,) = [w for w in left.mission.warnings if w.entry == "burns.dv_min_m_s"]
    assert warning.given == "burn 3 of 23.7 mm/s"


@pytest.mark.usefixtures("few_flights")
def test_a_file_with_a_zero_burn_is_verified(stored, tmp_path):
    checked = stored.with_verification(verify(stored.mission, stored))
    assert checked.verification.ok
    checked.write(tmp_path)
    read = read_solution(tmp_path)
    assert read.burns[2].dv_m_s == (0.0, 0.0, 0.0)
    assert verify(read.mission, read).ok
    fired = Burn(read.burns[2].t_s, (1e-3, 0.0, 0.0))
    other = replace(read, burns=[*read.burns[:2], fired, read.burns[3]])
    assert "max_defect" in verify(other.mission, other).failed


def test_a_zero_burn_is_no_manoeuvre(stored):
    text = opm_text(Export.of(stored))
    numbers = [line for line in text.splitlines() if line.startswith("COMMENT burn ")]
    assert [line.split()[2].rstrip(":;") for line in numbers if "mass" in line] == ["1", "2", "4"]
    assert text.count("MAN_EPOCH_IGNITION") == 3
    assert any("burn 3: none" in line for line in numbers)
    assert "COMMENT 3 burns, impulses; " in text


def test_a_zero_burn_is_shown_without_sign(stored):
    first = replace(stored.burns[0], dv_m_s=(-1e-9, 0.02, 1e-9))
    table = burns_table(replace(stored, burns=[first, *stored.burns[1:]]))
    shown = [[cell.text for cell in row] for row in table.rows]
    assert shown[0][3:] == ["+0.000", "+20.000", "+0.000", "20.000"]
    assert shown[2][3:] == ["0", "0", "0", "0"]
    assert [cell.value for cell in table.rows[2][3:]] == [0.0, 0.0, 0.0, 0.0]
    budget = budget_table(Shown("plan", stored, samples=100).budget)
    assert [cell.text for cell in budget.rows[2]] == ["3", "0", "0", "0"]
