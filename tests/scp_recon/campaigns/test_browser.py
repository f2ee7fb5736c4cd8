"""A campaign's page in headless Chromium; skipped where there is none, or no Playwright to drive it."""

from collections.abc import Iterator
from typing import Any

import pytest

from scp_recon.campaigns.outcome import read_campaign
from scp_recon.campaigns.page import write_page
from tests.helpers import nightly
from tests.scp_recon.browser import WINDOW, chromium, needed
from tests.scp_recon.campaigns.shown import ERRORS, PLACES, campaign_of

PATIENCE_MS = 200_000

COVERED = """[...document.querySelectorAll('[data-chart]')].filter(chart => {
  const [bar, ...legends] = ['.modebar', '.legend'].flatMap(
    name => [...chart.querySelectorAll(name)].slice(0, 1)).map(x => x.getBoundingClientRect());
  return legends.some(x => x.left < bar.right && bar.left < x.right && x.top < bar.bottom
    && bar.top < x.bottom);
}).map(chart => chart.ariaLabel)"""
"""Charts whose legend lies below Plotly's buttons."""

pytestmark = [needed, pytest.mark.slow]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as opened:
        yield opened


@nightly
@pytest.mark.parametrize(("tables", "charts"), [(PLACES, 3), (ERRORS, 2)])
def test_page_draws_and_opens_cases_without_network(browser, tmp_path, tables, charts):
    campaign_of(tables, tmp_path)
    file = write_page(read_campaign(tmp_path))
    page = browser.new_context(viewport=WINDOW).new_page()
    page.set_default_timeout(PATIENCE_MS)
    said: list[str] = []
    asked: list[str] = []
    page.on("pageerror", lambda error: said.append(str(error)))
    page.on("console", lambda m: said.append(m.text) if m.type == "error" else None)
    page.on("request", lambda request: asked.append(request.url))
    page.goto(file.as_uri(), wait_until="commit")
    page.wait_for_function("window.campaign")
    page.evaluate("campaign.drawn.then(() => 1)")
    drawn = (
        "[...document.querySelectorAll('[data-chart]')].filter(d => d.querySelector('.main-svg'))"
    )
    assert page.evaluate(f"{drawn}.length") == charts
    assert page.evaluate(COVERED) == []
    assert page.evaluate("document.getElementById('detail-3').hidden")
    page.evaluate(
        "document.querySelector('[data-chart]').emit('plotly_click', {points: [{customdata: 3}]})"
    )
    assert not page.evaluate("document.getElementById('detail-3').hidden")
    page.evaluate("document.querySelector('#case-3 button').click()")
    assert page.evaluate("document.getElementById('detail-3').hidden")
    assert said == []
    outside = [url for url in asked if not url.startswith(("data:", "blob:"))]
    assert outside == [file.as_uri()]
