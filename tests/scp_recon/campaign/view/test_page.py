"""What is shown of a campaign: its ends, pictures, page, and commands that make a case again."""

from __future__ import annotations

import re
import shlex
from datetime import UTC, datetime
from html import unescape
from io import BytesIO
from pathlib import Path

import pytest

from scp_recon.campaign import report
from scp_recon.campaign.study.study import Study
from scp_recon.campaign.view.figures import axes_of, figures
from scp_recon.campaign.view.labels import label
from scp_recon.campaign.view.outcome import CampaignResults, read_campaign
from scp_recon.campaign.view.page import render
from scp_recon.campaign.view.repeat import as_toml, command_lines
from scp_recon.errors import InputError
from scp_recon.scenario.load import load_scenario
from tests.scp_recon.campaign.view.shown import ERRORS, PLACES, campaign_of

MADE = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Study, CampaignResults]:
    folder = tmp_path_factory.mktemp("map")
    return campaign_of(PLACES, folder), read_campaign(folder)


@pytest.fixture(scope="module")
def errors(tmp_path_factory: pytest.TempPathFactory) -> CampaignResults:
    folder = tmp_path_factory.mktemp("errors")
    campaign_of(ERRORS, folder)
    return read_campaign(folder)


def test_every_case_has_its_end(mapped: tuple[Study, CampaignResults]) -> None:
    _, results = mapped
    latitudes = results.table["site.latitude_deg"]
    assert results.counts() == {
        "feasible": int(((latitudes >= 0) & (latitudes <= 60)).sum()),
        "infeasible": int(((latitudes < 0) & (latitudes >= -60)).sum()),
        "no mission": int((abs(latitudes) > 60).sum()),
    }
    assert results.verdict == f"{results.feasible} feasible of 24 cases"


def test_a_plan_that_is_not_verified_is_not_feasible(errors: CampaignResults) -> None:
    table = errors.table.assign(verdict="not verified: P(emission)")
    changed = CampaignResults(
        errors.folder, table, errors.base, errors.campaign, errors.entries, errors.cases
    )
    assert changed.counts() == {"not verified": 8}


def test_what_changes_together_is_one_axis(errors: CampaignResults) -> None:
    assert errors.free == ("uncertainty.execution_error", "battery.delta_v_cone_deg")
    assert axes_of(errors) == ("uncertainty.execution_error", "battery.delta_v_cone_deg", None)
    assert label("battery.delta_v_cone_deg") == "delta v cone (deg)"
    assert label("burns.dv_max_m_s") == "dv max (m/s)"


def test_pictures_suit_the_axes(
    mapped: tuple[Study, CampaignResults], errors: CampaignResults
) -> None:
    drawn = figures(mapped[1]) | figures(errors)
    assert list(drawn) == ["map", "globe", "curves"]
    for figure in drawn.values():
        picture = BytesIO()
        figure.savefig(picture, format="png", dpi=40)
        assert picture.getvalue().startswith(b"\x89PNG")
    curves = drawn["curves"].axes[0].lines
    assert [len(curve.get_xdata()) for curve in curves] == [4, 4]
    assert drawn["map"].axes[0].collections[0].get_offsets().shape == (mapped[1].feasible, 2)


@pytest.mark.parametrize("number", [0, 11])
def test_the_command_of_a_case_makes_its_scenario(
    mapped: tuple[Study, CampaignResults], number: int
) -> None:
    study, results = mapped
    page = unescape(render(results, MADE))
    found = re.search(rf'id="detail-{number}".*?<pre>(.*?)</pre>', page, re.DOTALL)
    assert found
    words = shlex.split(found[1])
    assert words[:4] == ["python", "-m", "scp_recon.design", "kingfisher"]
    assert words[-2:] == ["--certify", "no"]
    scenario = load_scenario(words[3], [w for w in words[4:-2] if w != "--set"])
    assert scenario == study.scenario_of(study.cases[number])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.5, "0.5"),
        ("a", '"a"'),
        ("24", "24"),
        ("true", '"true"'),
        ("[1, 2]", "[1, 2]"),
        ({"a": True}, "{ a = true }"),
    ],
)
def test_values_are_written_as_toml(value: object, text: str) -> None:
    assert as_toml(value) == text


def test_an_exact_plan_is_made_again_as_the_campaign_makes_it(errors: CampaignResults) -> None:
    (line,) = command_lines(errors.campaign, {}, 7, "exact")
    assert line.endswith(" --certify no")
    certified = errors.campaign.model_copy(update={"do": "certify"})
    assert "--certify" not in command_lines(certified, {}, 7, "exact")[0]


def test_epochs_may_stand_on_any_axis(tmp_path: Path) -> None:
    """And whole numbers stay whole."""
    axes = [
        {"entry": "epoch.tdb", "values": ["2020-01-22T00:00:00", "2020-02-22T00:00:00"]},
        {"entry": "uncertainty.execution_error", "values": [0.02, 0.04, 0.07]},
        {"entry": "polytopes.cone", "values": [4, 6, 8, 12]},
    ]
    for count in (2, 3):
        folder = tmp_path / str(count)
        campaign_of({"axis": axes[:count]}, folder)
        results = read_campaign(folder)
        assert "2020-02-22T00:00" in render(results, MADE)
        assert set(figures(results)) == {"curves"}
    assert results.table["polytopes.cone"].dtype.kind == "i"


def test_flights_and_simulations_follow_a_plan(errors: CampaignResults) -> None:
    for do, command in (("fly", "montecarlo"), ("simulate", "simulate")):
        campaign = errors.campaign.model_copy(update={"do": do, "samples": 500})
        first, second = command_lines(campaign, {"risk.p_chance": 0.8}, 7, "uniform")
        assert first == "python -m scp_recon.solve --scenario recon_b --set risk.p_chance=0.8"
        assert second.startswith(f"python -m scp_recon.{command} runs/latest")
        assert second.endswith("--seed 7")


def test_the_page_says_it_all_and_escapes(mapped: tuple[Study, CampaignResults]) -> None:
    _, results = mapped
    page = render(results, MADE)
    assert results.verdict in page
    assert page.count('class="detail"') == 24
    assert "&lt;at all&gt; &amp; none" in page
    assert "Broken most: emission_max" in page
    costs = [
        float(x) for x in re.findall(r'class="number">(0\.\d+)</td><td class="number">0.9<', page)
    ]
    assert costs == sorted(costs)
    assert len(costs) == results.feasible


def test_a_plan_that_was_kept_is_linked(mapped: tuple[Study, CampaignResults]) -> None:
    folder = mapped[1].folder
    kept = folder / "solutions" / "case-0000003"
    kept.mkdir(parents=True)
    (kept / "solution.json").write_text("{}")
    assert "scp_recon.report solutions/case-0000003" in render(mapped[1], MADE)
    (kept / "report.html").write_text("")
    assert 'href="solutions/case-0000003/report.html"' in render(mapped[1], MADE)


def test_what_was_stopped_is_shown_as_far_as_it_came(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    campaign_of(ERRORS, tmp_path, stop_after=5)
    assert report.main([str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "5 feasible of 5 cases run so far, of 8 in the study" in said
    assert {path.name for path in tmp_path.iterdir()} >= {"campaign.html", "curves.png"}


def test_a_folder_without_a_campaign_is_one_message(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must hold a campaign"):
        read_campaign(tmp_path)
    (tmp_path / "campaign.json").write_text('{"schema": "another"}')
    with pytest.raises(InputError, match="must hold a campaign"):
        read_campaign(tmp_path)
