"""What a report draws of corrections: the file's spread and knowledge, and the flights' delta-v."""

from datetime import UTC, datetime

import numpy as np
import pytest

import scp_recon as sr
from scp_recon.physics import geometry
from scp_recon.physics.frames import unit
from scp_recon.reports.charts import commanded_chart
from scp_recon.reports.histories import is_corrected, knowledge_chart, uncorrected
from scp_recon.reports.scene import picture
from scp_recon.reports.shown import Shown
from scp_recon.reports.write import page_of
from tests.scp_recon.verification.test_closed_loop import LAST_TOO, with_gains


@pytest.fixture(scope="module")
def shown() -> Shown:
    solution = with_gains("navigation.lead_s=3600", LAST_TOO)
    return Shown("corrected", solution, samples=200)


def test_knowledge_and_dispersion_are_drawn_at_the_nodes(shown):
    """In the file's figures; corrections narrow the spread at the end."""
    position, velocity = (
        [trace for trace in knowledge_chart([shown])["data"] if trace["yaxis"] == axis]
        for axis in ("y", "y2")
    )
    assert [trace["name"].split(":")[0] for trace in position] == [
        *("dispersion", "dispersion without corrections", "knowledge")
    ]
    nodes = shown.solution.nodes
    given = nodes.covariance, uncorrected(shown), nodes.knowledge
    for traces, part, scale in ((position, slice(3), 1.0), (velocity, slice(3, 6), 1000.0)):
        for trace, covariance in zip(traces, given, strict=True):
            variance = np.trace(np.array(covariance)[:, part, part], axis1=1, axis2=2)
            np.testing.assert_allclose(trace["y"], scale * np.sqrt(variance), rtol=1e-5)
        assert traces[1]["y"][0] == pytest.approx(traces[0]["y"][0], rel=1e-5)
        assert traces[1]["y"][-1] > traces[0]["y"][-1]


def test_delta_v_is_that_of_the_flights(shown):
    flights, *figures = commanded_chart([shown])["data"]
    assert np.sum(flights["y"][::2]) == pytest.approx(100.0, abs=1e-2)
    most = 1000.0 * float(np.quantile(shown.flown.commanded_m_s, 0.99))
    assert figures[2]["name"] == f"99 % {most:.2f} mm/s"
    assert figures[2]["x"][0] == pytest.approx(most, rel=1e-4)


@pytest.mark.slow
@pytest.mark.usefixtures("few_flights")
def test_python_has_the_charts_of_the_page(shown):
    drawn = sr.charts(shown.solution)
    on_page = page_of([shown], datetime.now(UTC)).charts
    assert [*drawn] == ["flight", *(chart["key"] for chart in on_page)]
    assert {"knowledge", "commanded"} < drawn.keys()
    both = sr.compare(shown.solution, shown.solution)
    assert len(both.plot("budget").data) == 2
    for chart in on_page:
        following = chart["key"] == "ground"  # a ring that follows the page's time
        assert len(drawn[chart["key"]].data) == len(chart["data"]) - following


def test_picture_is_of_the_middle_of_the_window(shown):
    traces = picture([shown])["data"]
    site, craft = (
        np.array([trace[axis][0] for axis in "xyz"])
        for group in ("site", "spacecraft")
        for trace in traces
        if trace["name"] == group
    )
    mission, times = shown.mission, np.array([np.mean(shown.mission.schedule.window_s)])
    track = geometry.track(mission.site, mission.rotation, times)
    distance = geometry.distance(shown.positions(times), track)
    # The mark is a little above ground.
    assert np.linalg.norm(craft - site) == pytest.approx(distance[0], abs=2.0)
    body, rays = traces[:2]
    brightest = np.transpose([body[axis] for axis in "xyz"])[np.argmax(body["intensity"])]
    sunwards = unit(np.array([rays[axis][0] for axis in "xyz"]))
    assert unit(brightest) @ sunwards > np.cos(0.2)


def test_a_plan_without_corrections_has_none_of_these(solution):
    assert not is_corrected(Shown("plain", solution))
