"""The page with sliders in headless Chromium; skipped where there is none, or no Playwright."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.scp_recon.browser import chromium, needed

PATIENCE_MS = 120_000

pytestmark = [needed, pytest.mark.slow]

MOVE = """([key, value]) => {
  const number = document.querySelector(`[data-key="${key}"]`);
  number.value = value;
  number.dispatchEvent(new Event("input", { bubbles: true }));
  return [explorer.state(), document.body.className, document.getElementById("save").disabled];
}"""
NOT_OF_THE_SLIDERS = ["planning", "pending stale", True]


def test_the_page_shows_the_plan_of_its_sliders(server, tmp_path):
    said: list[str] = []
    with chromium() as browser:
        page = browser.new_context(viewport={"width": 500, "height": 400}).new_page()
        page.set_default_timeout(PATIENCE_MS)
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("console", lambda m: said.append(m.text) if m.type == "error" else None)
        page.goto(f"http://{server.hosts[0]}/", wait_until="commit")
        page.wait_for_function("window.explorer && explorer.state() === 'judged'")
        before = page.inner_text("#cost")

        state, classes, unsaved = page.evaluate(MOVE, ["risk.p_chance", 0.8])
        assert [state, " ".join(sorted(classes.split())), unsaved] == NOT_OF_THE_SLIDERS
        assert page.inner_text("#cost") == ""
        page.wait_for_function("explorer.state() === 'judged'")
        solution = server.explorer.kept[1].solution
        assert solution.scenario.risk.p_chance == 0.8
        assert page.inner_text("#cost") == f"{1e3 * solution.total_dv_m_s:.1f} mm/s" != before
        assert "verified" in page.inner_text("#verdict strong")
        drawn = page.evaluate(
            "document.getElementById('flight').data.find(d => d.name.endsWith('burns')).x"
        )
        assert drawn == page.evaluate(
            "fetch('/plan', {method: 'POST', headers: {'Content-Type': 'application/json'}, body:"
            " JSON.stringify(explorer.values())}).then(got => got.json()).then(got =>"
            " got.drawn.scene.traces.find(d => d.name.endsWith('burns')).x)"
        )
        with page.expect_download() as download:
            page.click("#save")
        download.value.save_as(tmp_path / "mine.toml")
        assert "p_chance = 0.8\n" in Path(tmp_path / "mine.toml").read_text("utf-8")

        page.evaluate(MOVE, ["burns.times_s.1", 12_000])
        page.wait_for_function("explorer.state() === 'refused'")
        assert "may be between" in page.inner_text("#reason")
        assert page.evaluate("document.body.classList.contains('stale')")
        assert page.is_disabled("#save")
        assert page.evaluate(MOVE, ["risk.p_chance", 2])[0] == "refused"  # without the server
        page.click("#reset")
        assert page.evaluate("explorer.values()") == {}
    assert said == []
