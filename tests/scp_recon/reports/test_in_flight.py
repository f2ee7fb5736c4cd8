"""Reports of plans that are made in flight: nothing of them is before they begin."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from scp_recon.api.replans import plan_left
from scp_recon.planning.plan import Plan
from scp_recon.replanning.delivery import Delivery
from scp_recon.replanning.flown import FlownPlan, predict
from scp_recon.replanning.remainder import mission_left
from scp_recon.reports import flights
from scp_recon.reports.flights import fly
from scp_recon.reports.ground import Camera
from scp_recon.reports.page import Page, render
from scp_recon.reports.subject import subjects_of
from scp_recon.reports.write import page_of
from scp_recon.results.solution import Solution, make_solution

from .conftest import MADE

IN_THE_WINDOW, AFTER_IT = 15_000.0, 17_000.0
OF_THE_WINDOW = {"observation", "resolution"}


@pytest.fixture(autouse=True)
def _few_flights(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flights, "fly", partial(fly, samples=100))


@pytest.fixture(scope="module")
def left(default_plan: Plan) -> dict[float, Solution]:
    flown = FlownPlan.of(default_plan)

    def from_time(at_s: float) -> Solution:
        delivery = Delivery(at_s, predict(flown, at_s, {}).state)
        return make_solution(plan_left(flown, mission_left(flown, delivery, ())))

    return {at_s: from_time(at_s) for at_s in (IN_THE_WINDOW, AFTER_IT)}


def earliest(page: Page, keys: set[str]) -> float:
    """Of all times on the horizontal axes of some charts."""
    charts = [chart for chart in page.charts if chart["key"] in keys]
    given = [trace["x"] for chart in charts for trace in chart["data"]]
    return float(min(np.nanmin(np.array(x, dtype=float)) for x in given if len(x)))


@pytest.mark.parametrize("at_s", [IN_THE_WINDOW, AFTER_IT])
def test_nothing_is_shown_of_a_time_before_the_plan(
    left: dict[float, Solution], at_s: float
) -> None:
    (subject,) = subjects_of([left[at_s]])
    assert fly(subject, samples=10).times_s[0] == at_s
    page = page_of([subject], Camera(), MADE)
    assert earliest(page, {"ranges", "probability", *OF_THE_WINDOW}) == pytest.approx(at_s)
    moving = page.scene["motion"]
    assert moving["ends_s"][0] == at_s
    assert all(look >= at_s for look in moving["plans"][0]["looks_s"])
    shown = {chart["key"] for chart in page.charts}
    assert (shown >= OF_THE_WINDOW) == (at_s < subject.mission.schedule.window_s[1])
    assert "<html" in render(page)


def test_burns_have_the_numbers_that_they_have_in_the_flight(left: dict[float, Solution]) -> None:
    page = page_of(subjects_of([left[AFTER_IT]]), Camera(), MADE)
    charts = {chart["key"]: chart["data"] for chart in page.charts}
    assert charts["budget"][0]["x"] == ["burn 3", "burn 4"]
    words = [word["text"] for word in page.scene["layout"]["scene"]["annotations"]]
    words += [text for trace in charts["timeline"] for text in trace.get("text", ())]
    assert [word[0] for word in words if word.endswith("mm/s")] == ["3", "4"] * 2
    tables = {table.key: table for table in page.tables[0]}
    assert [row[0].text for row in tables["burns"].rows[:2]] == ["3", "4"]
    assert [row[0].text for row in tables["budget"].rows[:2]] == ["3", "4"]
