"""Ends, pictures and page of a campaign."""

import re
from dataclasses import replace
from datetime import UTC, datetime
from html import unescape

import pytest

import scp_recon as sr
from scp_recon.campaigns.outcome import CampaignResults, in_words, read_campaign, remarks
from scp_recon.campaigns.page import charts_of, figures, render
from scp_recon.campaigns.run import FILE_NAME
from scp_recon.campaigns.study import Study
from scp_recon.cli.commands import report
from scp_recon.errors import InputError
from tests.scp_recon.campaigns.shown import ERRORS, PLACES, campaign_of

MADE = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory) -> tuple[Study, CampaignResults]:
    folder = tmp_path_factory.mktemp("map")
    return campaign_of(PLACES, folder), read_campaign(folder)


@pytest.fixture(scope="module")
def errors(tmp_path_factory) -> CampaignResults:
    folder = tmp_path_factory.mktemp("errors")
    campaign_of(ERRORS, folder)
    return read_campaign(folder)


@pytest.mark.slow
@pytest.mark.parametrize("column", ["flown_shortfalls", "simulated_shortfalls"])
def test_remarks_say_why_cases_have_no_plan(mapped, errors, column):
    """Nor is feasible what fell short of its limits in its flights, or with the spacecraft."""
    said = remarks(mapped[1])
    assert any(line.startswith("Broken most: emission_max (") for line in said)
    assert any(line.startswith("No mission: design: no window <at all> & none (") for line in said)
    statuses, warned = ["timed out", *["converged"] * 7], ["odd mass", *[None] * 7]
    message = ["took longer\nthan " + "9" * 300, *[None] * 7]
    late = errors.table.assign(status=statuses, message=message, warnings=warned)
    late = late.assign(verdict=[None, *["not verified: P(x)"] * 6, "verified"])
    short = late.assign(**{column: [*[None] * 7, "<short> of it"]})
    changed = replace(errors, table=short)
    assert changed.counts() == {"not verified": 7, "no answer": 1}
    said = remarks(changed)
    assert any("7 not verified" in line for line in said)
    assert any(line.startswith("Not borne out: ") and "<short> of it (1)" in line for line in said)
    assert "Warned: odd mass (1)." in said
    (answer,) = (line for line in said if line.startswith("No answer: took longer than 999"))
    assert len(answer) < 200


def test_charts_draw_the_cheapest_case_of_a_place(tmp_path):
    sites = [
        {"entry": "site.latitude_deg", "values": [-30.0, 30.0]},
        {"entry": "site.longitude_deg", "grid": {"from": 0.0, "to": 240.0, "count": 3}},
    ]
    chances = {"entry": "risk.p_chance", "values": [0.9, 0.7]}
    campaign_of({"axis": [*sites, chances]}, tmp_path / "map")
    results = read_campaign(tmp_path / "map")
    assert (len(results.table), results.feasible) == (12, 6)
    assert list(results.by_site.table["case"]) == [0, 2, 4, 6, 8, 10], (
        "the first is cheaper by hand"
    )
    drawn = figures(results)
    assert list(drawn) == ["map_dv99_m_s", "map_probability", "shape"]
    assert len(drawn["map_probability"].data[0].x) == 3
    assert any("cheapest" in line for line in remarks(results))
    assert not any(line.startswith("Required") for line in remarks(results)), "it is an axis"
    grids = [
        {"entry": entry, "values": values}
        for entry, values in (
            ("uncertainty.execution_error", [0.02, 0.04, 0.08]),
            ("burns.dv_max_m_s", [0.1, 0.2]),
            ("safety.radius_min_m", [400.0, 500.0]),
            ("polytopes.ball", ["paper", "tangent"]),
        )
    ]
    for count in (3, 4):
        campaign_of({"axis": grids[:count]}, tmp_path / str(count))
        results = read_campaign(tmp_path / str(count))
        assert results.overlaid == (count == 4)
        assert all(len(trace["x"]) == 3 for trace in charts_of(results)[0]["data"])


@pytest.mark.parametrize(
    ("factor", "name"), [(1.0, "delta-v (m/s)"), (1.2, "99 % of commanded delta-v (m/s)")]
)
def test_delta_v_says_what_it_is_of(errors, factor, name):
    """With feedback of what 99 % of flights command; entries keep their digits."""
    table = errors.table.assign(dv99_m_s=factor * errors.table["total_dv_m_s"])
    changed = replace(errors, table=table)
    assert charts_of(changed)[0]["layout"]["yaxis"]["title"]["text"] == name
    assert f'<th scope="col">{name}</th>' in render(changed, MADE)
    assert any(line.startswith(name.capitalize()) for line in remarks(changed))
    assert [in_words(value) for value in (1800.0, 36_000, 0.04)] == ["1800", "36000", "0.04"]


@pytest.mark.slow
def test_page_shows_every_case_and_escapes_text(mapped):
    """Each case with what it changes; a plan that was kept is linked."""
    _, results = mapped
    kept = results.folder / "solutions" / "case-0000003"
    kept.mkdir(parents=True)
    (kept / "solution.json").write_text("{}")
    page = render(results, MADE)
    assert results.verdict in page
    assert "<p>Required: at least 0.7 " in page
    assert page.count('class="detail"') == 24
    assert "&lt;at all&gt; &amp; none" in page
    assert "Broken most: emission_max" in page
    assert "report solutions/case-0000003" in page
    costs = [
        float(x) for x in re.findall(r'class="number">(0\.\d+)</td><td class="number">0.9<', page)
    ]
    assert costs == sorted(costs)
    assert len(costs) == results.feasible
    found = re.search(r'id="detail-11".*?<p>(site[^<]*)</p>', unescape(page), re.DOTALL)
    assert found
    row = results.table.set_index("case").loc[11]
    for entry in (*results.entries, "seed"):
        assert f"{entry} = {row[entry]}" in found[1]
    (kept / "report.html").write_text("")
    assert 'href="solutions/case-0000003/report.html"' in render(results, MADE)


def test_stopped_campaign_has_a_page(tmp_path, capsys):
    campaign_of(ERRORS, tmp_path, stop_after=5)
    assert report.main([str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "5 feasible of 5 cases" in said
    assert {path.name for path in tmp_path.iterdir()} >= {"campaign.html"}
    assert report.main([str(tmp_path), "--out", "r.html"]) == 2
    assert "--out: got r.html" in capsys.readouterr().err
    with pytest.raises(InputError, match="pixels: got 3"):
        sr.report(tmp_path, pixels=3)


def test_folder_without_campaign_is_refused(tmp_path):
    for text in (None, '{"schema": "another"}'):
        if text:
            (tmp_path / FILE_NAME).write_text(text)
        with pytest.raises(InputError, match="must hold a campaign"):
            read_campaign(tmp_path)
