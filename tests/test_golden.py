"""The golden record: one run every day, all of it nightly."""

from datetime import date

import pytest

from tests.golden import LONG, RUNS, differences, flat, kind_of, moved, run_of, same, spread
from tests.helpers import nightly

KEPT = {
    "figures": {"status": "converged", "burns.0.dv_m_s": [0.1, 0.2]},
    "within": {"burns.dv_m_s": 3e-6},
}


@pytest.mark.slow
def test_one_run_of_the_record_holds_today():
    assert differences([run_of(date.today())]) == []


@nightly
@pytest.mark.timeout(1800)
def test_the_whole_record_holds():
    assert differences([*RUNS]) == []


def test_two_days_compare_different_runs():
    days = {run_of(date(2026, 1, day)) for day in range(1, 11)}
    assert len(days) > 5
    assert days <= set(RUNS) - set(LONG)
    assert set(LONG) < set(RUNS)


@pytest.mark.parametrize(
    ("fresh", "count"),
    [
        ({"status": "converged", "burns.0.dv_m_s": [0.1, 0.200002], "new": 1}, 0),
        ({"status": "converged", "burns.0.dv_m_s": [0.1, 0.20001]}, 1),
        ({"status": "infeasible", "burns.0.dv_m_s": [0.1]}, 2),
        ({}, 2),
    ],
)
def test_figures_beyond_their_tolerance_have_moved(fresh, count):
    assert len(list(moved(KEPT, fresh, "run"))) == count


def test_truths_and_texts_agree_exactly_only():
    assert not same(True, 1, 1.0)
    assert same("a", "a", 0.0)
    assert not same(None, 0.0, 1.0)
    assert spread([1.0, [2.0]], [1.5, [1.0]]) == 1.0
    assert kind_of("plan.burns.0.dv_m_s") == "plan.burns.dv_m_s"
    assert kind_of("windows_csv.3") == "windows_csv.3"


def test_sentences_and_seconds_are_not_kept():
    answer = {"message": "it has ended", "timing_s": 3.0, "status": "converged", "t": [*range(25)]}
    assert flat(answer, "said") == {
        "said.status": "converged",
        "said.t": [0.0, 3.0, 6.0, 9.0, 12.0, 15.0, 18.0, 21.0, 24.0],
        "said.t.number": 25,
    }
