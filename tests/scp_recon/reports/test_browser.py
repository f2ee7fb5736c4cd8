"""The page in headless Chromium; skipped where there is none, or no Playwright to drive it."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from scp_recon.physics import geometry
from tests.helpers import nightly
from tests.scp_recon.browser import WINDOW, chromium, needed

PATIENCE_MS = 120_000

pytestmark = [needed, pytest.mark.slow]


@dataclass
class Seen:
    """An open page and what it has said and asked for."""

    page: Any
    said: list[str] = field(default_factory=list)
    asked_for: list[str] = field(default_factory=list)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as opened:
        yield opened


@pytest.fixture(scope="module")
def seen(browser, html_file) -> Seen:
    page = browser.new_context(viewport=WINDOW).new_page()
    page.set_default_timeout(PATIENCE_MS)
    found = Seen(page)
    page.on("pageerror", lambda error: found.said.append(str(error)))
    page.on("console", lambda m: found.said.append(m.text) if m.type == "error" else None)
    page.on("request", lambda request: found.asked_for.append(request.url))
    page.goto(html_file.as_uri(), wait_until="commit")
    page.wait_for_function("window.report")
    page.evaluate("report.rest.then(() => 1)")
    return found


def test_page_loads_without_errors_or_network(seen, html_file):
    assert seen.said == []
    outside = [url for url in seen.asked_for if not url.startswith(("data:", "blob:"))]
    assert outside == [html_file.as_uri()]


def test_verdict_is_readable_before_charts_are_drawn(seen):
    painted, view = seen.page.evaluate(
        "[performance.getEntriesByName('first-contentful-paint')[0].startTime,"
        " performance.getEntriesByName('first-view')[0].startTime]"
    )
    assert painted < view
    drawn = seen.page.evaluate(
        "[...document.querySelectorAll('[data-chart]')]"
        ".map(d => d.querySelectorAll('.main-svg').length)"
    )
    assert len(drawn) == 9
    assert all(drawn)
    assert seen.page.locator("#flight canvas").count() >= 1


def test_slider_moves_the_spacecraft_to_each_node(seen, shown):
    states = np.array(shown.solution.nodes.state)
    for node in (0, 40, len(states) - 1):
        time = shown.nodes_s[node]
        seen.page.evaluate(
            "t => { const s = document.getElementById('time'); s.value = t;"
            " s.dispatchEvent(new Event('input')); }",
            float(time),
        )
        seen.page.wait_for_function(
            "t => { const s = document.getElementById('flight'); const i = s.data.findIndex("
            "d => d.meta.moves === 'craft'); const p = report.craftAt(0, t);"
            " return Math.hypot(s.data[i].x[0] - p[0], s.data[i].y[0] - p[1]) < 1e-6; }",
            arg=float(time),
        )
        drawn = seen.page.evaluate(
            "() => { const s = document.getElementById('flight');"
            " const d = s.data.find(d => d.meta.moves === 'craft'); return [d.x[0], d.y[0], d.z[0]]; }"
        )
        expected = np.linalg.norm(states[node, :3])
        assert np.linalg.norm(drawn) == pytest.approx(expected, abs=0.05)
        assert f"t = {time:.0f} s | 2020-01-2" in seen.page.inner_text("#readout")
    seen.page.evaluate("report.show(15000)")
    mission, times = shown.mission, np.array([15_000.0])
    site = geometry.track(mission.site, mission.rotation, times)
    away = geometry.distance(shown.positions(times), site)[0]
    assert f"observation, {away:.0f} m from the site" in seen.page.inner_text("#readout")


def test_the_body_turns_and_night_moves_over_it(seen):
    take = (
        "() => { const d = document.getElementById('flight').data[0];"
        " return [Array.from(d.x), Array.from(d.intensity)]; }"
    )
    seen.page.evaluate("report.show(0)")
    before = [np.array(values) for values in seen.page.evaluate(take)]
    seen.page.evaluate("report.show(7731)")  # half a turn of Bennu
    after = [np.array(values) for values in seen.page.evaluate(take)]
    assert np.abs(after[0] - before[0]).max() > 400.0
    assert np.corrcoef(before[1], after[1])[0, 1] < 0.3
    assert 0.3 < (after[1] > 0.0).mean() < 0.7


def test_tables_are_read_without_scripts(browser, html_file, shown):
    page = browser.new_context(java_script_enabled=False).new_page()
    page.goto(html_file.as_uri())
    assert "Required:" in page.inner_text("header")
    total = page.locator("[data-table=burns] tr").last.locator("td").last
    assert float(total.get_attribute("data-value")) == shown.solution.total_dv_m_s
    page.context.close()


@nightly
def test_printed_page_has_every_chart(browser, html_file):
    """As a browser without a window does, which waits for no frame."""
    page = browser.new_context(viewport=WINDOW).new_page()
    page.add_init_script(
        "const frame = requestAnimationFrame; let held = false;"
        "window.requestAnimationFrame = (f) => held ? frame(f) : (held = true, 0)"
    )
    page.goto(html_file.as_uri())
    assert page.evaluate("window.report === undefined")
    drawn = page.evaluate(
        "dispatchEvent(new Event('beforeprint')),"
        " [...document.querySelectorAll('[data-chart]')].map((div) => !!div.querySelector('svg path'))"
    )
    assert drawn == [True] * 9
    assert page.evaluate("document.getElementById('still').src").startswith("data:image/png")
    page.close()
