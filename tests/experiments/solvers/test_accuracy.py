"""Accuracy over time: stopped runs lead to the whole one, and tables say when a method stays near."""

import numpy as np
import pytest

from experiments.solvers.accuracy import ENOUGH, Begun, begin, judged, reached, run_to
from experiments.solvers.cases import REFERENCE, SHOOTING, Method


@pytest.fixture(scope="module")
def begun() -> dict[str, Begun]:
    return {"recon_b": begin("recon_b")}


@pytest.mark.parametrize("method", [REFERENCE, SHOOTING, Method("condensed", "ptr", "CLARABEL")])
def test_a_run_stops_where_it_is_told_or_ends_by_itself_at_the_one_optimum(begun, method):
    first, whole = (run_to(begun, ("recon_b", method, most)) for most in (1, ENOUGH))
    assert (first["iterations"], first["ended"]) == (1, False)
    assert 1 < whole["iterations"] < ENOUGH
    assert whole["ended"]
    assert whole["merit_m_s"] == pytest.approx(0.1401352, rel=1e-6)  # the default plan's
    assert first["merit_m_s"] > (1.0 + 1e-6) * whole["merit_m_s"]


def row(method: str, iterations: int, merit: float, *, ended: bool = False) -> dict[str, object]:
    return {
        "problem": "p",
        "method": method,
        "iterations": iterations,
        "ended": ended,
        "processor_s": 0.1 * iterations,
        "merit_m_s": merit,
    }


def test_near_is_counted_from_where_a_method_stays_near_the_least_end():
    rows = [
        *(row("a", 1, 1.005), row("a", 2, 1.5), row("a", 3, 1.005), row("a", 4, 1.0, ended=True)),
        *(row("b", 1, 0.99), row("b", 2, 1.02, ended=True)),
    ]
    rows[0]["processor_s"] = 0.35  # lengthened by other work
    a, b = reached(judged(rows))
    assert judged(rows)[0]["processor_s"] == pytest.approx(0.2)
    assert [a["iterations"], b["iterations"]] == [4, 2]
    assert a["within_1e2_s"] == pytest.approx(0.3)
    assert a["within_1e6_s"] == a["end_s"] == pytest.approx(0.4)
    assert a["end_error"] == 0.0
    assert np.isnan(b["within_1e2_s"])
    assert b["end_error"] == pytest.approx(0.02)
