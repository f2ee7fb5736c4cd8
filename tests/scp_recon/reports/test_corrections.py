"""What a report draws of corrections: the file's own spread and knowledge, and the flights' delta-v."""

import itertools
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest

import scp_recon as sr
from scp_recon.physics import geometry
from scp_recon.physics.frames import unit
from scp_recon.reports.corrections import ELLIPSE, correction_charts, covariances_of
from scp_recon.reports.ground import Camera
from scp_recon.reports.scene import picture
from scp_recon.reports.shown import Shown
from scp_recon.reports.subject import Subject
from scp_recon.reports.surfaces import shape_of
from scp_recon.reports.write import page_of
from tests.scp_recon.verification.test_closed_loop import LAST_TOO, with_gains


@pytest.fixture(scope="module")
def subject() -> Subject:
    return Subject("corrected", with_gains("navigation.lead_s=3600", LAST_TOO))


@pytest.fixture(scope="module")
def shown(subject) -> Shown:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scp_recon.reports.shown.SAMPLES", 200)
        return Shown.of(subject, shape_of(subject.solution.scenario), Camera())


@pytest.fixture(scope="module")
def charts(shown) -> dict[str, dict[str, Any]]:
    return {chart["key"]: chart for chart in correction_charts([shown])}


def test_all_corrections_together_are_the_files_covariance(subject):
    found, nodes = covariances_of(subject), subject.solution.nodes
    size = np.outer(subject.mission.units.state, subject.mission.units.state)
    assert len(found) == 4
    last = found[-1] / size
    np.testing.assert_allclose(last, np.array(nodes.covariance) / size, rtol=1e-6, atol=1e-9)
    for before, after in itertools.pairwise(found):
        assert np.abs(before / size - after / size).max() > 1e-6


def test_knowledge_and_dispersion_are_drawn_at_the_nodes(charts, subject):
    position, velocity = (
        [t for t in charts["knowledge"]["data"] if t["yaxis"] == axis] for axis in ("y", "y2")
    )
    known = np.array(subject.solution.nodes.knowledge)
    assert [trace["name"].split(":")[0] for trace in position] == [
        *("dispersion", "dispersion without corrections", "knowledge")
    ]
    sigma = np.sqrt(np.trace(known[:, :3, :3], axis1=1, axis2=2))
    np.testing.assert_allclose(position[2]["y"], sigma, rtol=1e-5)
    sigma = 1000.0 * np.sqrt(np.trace(known[:, 3:, 3:], axis1=1, axis2=2))
    np.testing.assert_allclose(velocity[2]["y"], sigma, rtol=1e-5)


def test_each_correction_has_ellipses_before_and_after_it(charts, subject):
    """The longer axis of the first is as long as its covariance says, along the chart."""
    data = charts["ellipses"]["data"]
    assert [trace["name"] for trace in data] == 3 * ["before", "after"]
    titles = [note["text"] for note in charts["ellipses"]["layout"]["annotations"]]
    assert ["burn 2" in titles[0], "burn 3" in titles[1], "burn 4" in titles[2]] == 3 * [True]
    end = covariances_of(subject)[1][-1, :3, :3]
    longest = ELLIPSE * np.sqrt(np.linalg.eigvalsh(end)[-1])
    assert max(data[2]["x"]) == pytest.approx(longest, rel=1e-2)
    assert max(np.hypot(data[2]["x"], data[2]["y"])) == pytest.approx(longest, rel=1e-2)


def test_delta_v_is_that_of_the_flights(charts, shown):
    flights, *figures = charts["commanded"]["data"]
    assert np.sum(flights["y"][::2]) == pytest.approx(100.0, abs=1e-2)
    most = 1000.0 * float(np.quantile(shown.flown.commanded_m_s, 0.99))
    assert figures[2]["name"] == f"99 % {most:.2f} mm/s"
    assert figures[2]["x"][0] == pytest.approx(most, rel=1e-4)


@pytest.mark.slow
def test_python_has_the_charts_of_the_page(shown, subject, monkeypatch):
    monkeypatch.setattr(Shown, "of", lambda *_: shown)
    drawn = sr.charts(subject.solution)
    on_page = page_of([subject], Camera(), datetime.now(UTC)).charts
    assert [*drawn] == ["flight", *(chart["key"] for chart in on_page)]
    assert {"knowledge", "ellipses", "commanded"} < drawn.keys()
    both = sr.compare(subject.solution, subject.solution)
    assert len(both.plot("budget").data) == 2
    for chart in on_page:
        following = chart["key"] == "ground"  # a ring that follows the page's time
        assert len(drawn[chart["key"]].data) == len(chart["data"]) - following


def test_picture_is_of_the_middle_of_the_window(shown, subject):
    traces = picture([shown], shown.shape)["data"]
    site, craft = (
        np.array([trace[axis][0] for axis in "xyz"])
        for group in ("site", "spacecraft")
        for trace in traces
        if trace["name"] == group
    )
    mission, times = subject.mission, np.array([np.mean(subject.mission.schedule.window_s)])
    track = geometry.track(mission.site, mission.rotation, times)
    distance = geometry.distance(subject.positions(times), track)
    # The mark is a little above ground.
    assert np.linalg.norm(craft - site) == pytest.approx(distance[0], abs=2.0)
    body, rays = traces[:2]
    brightest = np.transpose([body[axis] for axis in "xyz"])[np.argmax(body["intensity"])]
    sunwards = unit(np.array([rays[axis][0] for axis in "xyz"]))
    assert unit(brightest) @ sunwards > np.cos(0.2)


def test_a_plan_without_corrections_has_none_of_these(solution, shown):
    plain = replace(shown, subject=Subject("plain", solution))
    assert list(correction_charts([plain])) == []
