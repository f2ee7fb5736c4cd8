"""Studies as read, and refused before any work."""

import time
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scp_recon.campaigns.axes import Cases, changed
from scp_recon.campaigns.study import Study, files_in, read_study
from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.scenario.load import load_scenario


def axis(entry: str, *values: Any) -> dict[str, Any]:
    return {"entry": entry, "values": [*values]}


P_CHANCE = axis("risk.p_chance", 0.7, 0.8)
ENTRIES = ["site.latitude_deg", "site.longitude_deg"]
PLACES = {"entries": ENTRIES, "values": [[10.0, 20.0], [0.0, 90.0]]}


def study(*axes: dict[str, Any], **campaign: Any) -> Study:
    return Study.validated({"campaign": campaign, "axis": list(axes)})


@pytest.mark.slow
@given(st.lists(st.integers(1, 5), max_size=4), st.integers(0, 2**63 - 1))
def test_the_cases_are_the_product_of_the_axes(sizes, seed):
    axes = tuple([{f"e{k}": i} for i in range(size)] for k, size in enumerate(sizes))
    cases = Cases(axes, seed)
    found = [tuple(cases[n].changes[f"e{k}"] for k in range(len(sizes))) for n in range(len(cases))]
    assert found == list(np.ndindex(*sizes))
    assert [cases[n].number for n in range(len(cases))] == list(range(len(found)))


def test_every_kind_of_axis_gives_its_rows():
    found = study(
        {"entries": ["risk.p_chance", "burns.dv_max_m_s"], "values": [[0.7, 0.2], [0.8, 0.3]]},
        {
            "entry": "uncertainty.execution_error",
            "grid": {"from": 0.01, "to": 0.16, "count": 5, "scale": "log"},
        },
        PLACES,
        {
            "draws": [{"entry": "spacecraft.mass_kg", "law": "uniform", "low": 170, "high": 190}],
            "count": 6,
        },
    )
    assert len(found.cases) == 2 * 5 * 2 * 6
    errors = [row["uncertainty.execution_error"] for row in found.axes[1]]
    assert errors == pytest.approx([0.01, 0.02, 0.04, 0.08, 0.16])
    masses = [row["spacecraft.mass_kg"] for row in found.axes[3]]
    assert len(set(masses)) == 6
    assert all(170 <= mass < 190 for mass in masses)
    scenario = changed(found.base, found.cases[6].changes, found.folder)
    assert (scenario.site.latitude_deg, scenario.site.longitude_deg) == (0.0, 90.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("law", "mean", "spread"),
    [
        ({"law": "normal", "mean": 180.0, "sigma": 5.0}, 180.0, 5.0),
        ({"law": "lognormal", "mean": 5.0, "sigma": 0.1}, 149.157, 14.953),
        ({"law": "uniform", "low": 170.0, "high": 190.0}, 180.0, 20 / 12**0.5),
        ({"law": "loguniform", "low": 100.0, "high": 200.0}, 144.27, 28.69),
    ],
)
def test_more_draws_keep_the_first_ones(law, mean, spread):
    def drawn(count: int) -> list[float]:
        axis = {"draws": [{"entry": "spacecraft.mass_kg", **law}], "count": count}
        return [row["spacecraft.mass_kg"] for row in study(axis).axes[0]]

    many = drawn(4_000)
    assert np.mean(many) == pytest.approx(mean, abs=5 * spread / 4_000**0.5)
    assert np.std(many) == pytest.approx(spread, rel=0.1)
    assert drawn(10) == many[:10]


def test_epochs_are_taken_from_the_lighting_windows():
    """Each is a mission whose window stands between the same burns as the base's."""
    found = study({"windows": {"span_days": 2.0}})
    assert len(found.cases) > 5
    base = Mission.from_scenario(load_scenario("recon_b"))
    gap = np.searchsorted(base.scenario.burns.times_s, base.schedule.window_s)
    for number in (0, len(found.cases) - 1):
        scenario = changed(found.base, found.cases[number].changes, found.folder)
        mission = Mission.from_scenario(scenario)
        times = mission.scenario.burns.times_s
        assert (np.searchsorted(times, mission.schedule.window_s) == gap).all()


P, FIRST = "risk.p_chance", "axis 1, row 1: risk.p_chance"
GRID = {"from": 0, "to": 1, "count": 3}
HALF = {"entry": P, "law": "normal", "low": 1}
BEYOND = {"entry": P, "law": "uniform", "low": 3, "high": 4}


BAD_AXES: list[tuple[dict[str, Any], str, str]] = [
    ({"entry": "risk.p_chnce", "values": [1]}, "axis 1, row 1: risk.p_chnce", "did you mean"),
    ({"entry": P, "values": []}, "axis 1.values", "at least 1"),
    ({"entry": P, "values": [7.0, 0.7]}, FIRST, "must be"),
    ({"entry": P}, "axis 1", "must have one of"),
    ({"entry": P, "values": [1], "count": 3}, "axis 1", "with entry or entries, not entry, count"),
    ({"entries": ["a.b", "c.d"], "values": [[1]]}, "axis 1", "must have 2 items"),
    ({"entry": P, "grid": GRID | {"count": 0}}, "axis 1.grid.count", "at least 1"),
    ({"entry": P, "grid": GRID | {"scale": "log"}}, "axis 1.grid", "positive"),
    ({"draws": [HALF], "count": 2}, "axis 1.draws.0", "must have mean and sigma"),
    ({"draws": [BEYOND], "count": 2}, FIRST, "must be"),
    ({"windows": {"span_days": 0.02}}, "windows", "must find one"),
    ({"windows": {"from": "2020-01-21T20:33:17Z", "span_days": 2}}, "axis 1.windows.from", ""),
    ({"entries": [P, P], "values": [[0.7, 0.8]]}, "axis 1", "each entry once"),
    ({"entries": [], "values": [[], []]}, "axis 1.entries", "at least 1"),
    ({"draws": [BEYOND, BEYOND], "count": 2}, "axis 1", "each entry once"),
]


BAD_CAMPAIGNS: list[tuple[dict[str, Any], str, str]] = [
    ({"do": "fyl"}, "campaign.do", "plan"),
    ({"do": "certify"}, "campaign.do", "exact"),
    ({"base": "nowhere"}, "scenario nowhere", "must be a readable"),
    ({"overrides": {P: 2}}, P, "must be"),
    ({"limit_s": 0}, "campaign.limit_s", "at least 0.1"),
    ({"baze": "x"}, "campaign.baze", "did you mean campaign.base?"),
]


@pytest.mark.parametrize(
    ("axes", "campaign", "entry", "words"),
    [
        *(([axis], {}, *said) for axis, *said in BAD_AXES),
        *(([], campaign, *said) for campaign, *said in BAD_CAMPAIGNS),
    ],
)
def test_a_bad_axis_or_campaign_is_refused(axes, campaign, entry, words):
    with pytest.raises(InputError) as caught:
        study(*axes, **campaign)
    assert caught.value.entry == entry
    assert words in str(caught.value)


def test_everything_that_is_wrong_is_told():
    with pytest.raises(InputError) as caught:
        study(axis(P, 2, 3), axis("burns.dv_max", 1))
    assert str(caught.value).count("got ") == 3
    assert "axis 2, row 1: burns.dv_max" in str(caught.value)


def test_axes_invalid_in_every_combination_are_refused():
    """Each is a scenario alone."""
    sigmas = ("initial_sigma_position_m", "initial_sigma_velocity_m_s", "initial_frame")
    absolute = {
        "entries": [f"uncertainty.{name}" for name in sigmas],
        "values": [[[10.0] * 3, [5e-4] * 3, "j2000"]],
    }
    study(absolute)
    with pytest.raises(InputError, match="all axes together"):
        study(axis("uncertainty.initial_sigma_fraction", 0.01, 0.02), absolute)


MEAN_P = {"overrides": {"risk": {"p_chance": 0.9}}}
MEASURED = {"navigation": {"sigma_position_m": 10.0, "sigma_velocity_m_s": 5e-4}}
FEEDBACK = {"policy.kind": "feedback", "navigation.sigma_velocity_m_s": 5e-4}
KIND = axis("policy.kind", "open", "feedback")
COST = axis("policy.cost", "nominal", "dv99")
LEAD_S = "navigation.lead_s"
LEAD = axis(LEAD_S, 0.0, 60.0)
REPLANNED = {"do": "fly", "policy": "replan"}


GIVEN_TIMES = {"design.burn_times": "given"}
POINTS = axis("boundary.final_position_m", [1, 2, 3], [1.0, 2.0, 3.0])
BESIDE = [{"windows": {"span_days": 0.5}}, PLACES]
CLOSED = {"policy.kind": "feedback"} | MEASURED
IDLE: list[tuple[list[dict[str, Any]], dict[str, Any], str]] = [
    ([], {"samples": 1_000_000}, r"campaign.samples: got 1000000 with do = 'plan'; needs"),
    ([axis("design.departure_s", [0, 0])], {}, r"1: design.departure_s: .*; needs do = 'design'"),
    ([], {"overrides": GIVEN_TIMES}, r"overrides: design.burn_times: got"),
    (
        [axis("campaign.free_times", True)],
        {},
        "campaign.free_times: got True with do = 'plan'; needs",
    ),
    ([], {"at_s": 5.0}, "campaign.at_s: got 5.0 with do = 'plan'; needs do = 'replan'"),
    ([axis("campaign.at_s", -1.0)], {"do": "replan"}, "campaign.at_s: got -1"),
    ([axis("campaign.seed", 1)], {"do": "replan"}, "seed: got an axis; must be one of"),
    ([P_CHANCE, P_CHANCE], {}, "must be in one place"),
    ([P_CHANCE, axis("risk", {"p_chance": 0.9})], {}, f"{P}: got axis 1 and axis 2"),
    ([P_CHANCE], MEAN_P, f"{P}: got campaign.overrides and axis 1; must be in one place"),
    ([axis("risk", {"p_chance": 0.8})], {"overrides": {P: 0.9}}, f"{P}: got .*s and axis 1"),
    ([axis(P, 0.7, 0.8, 0.7)], {}, r"row 3: .* row 1 again"),
    ([POINTS], {}, r"row 2: .* row 1 again"),
    (BESIDE, {}, "axis 2: site.latitude_deg: got 10.0 beside windows of the base's site"),
    (
        [COST],
        {"overrides": MEASURED},
        r"axis 1: policy.cost: got 'nominal' with policy.kind = 'open'",
    ),
    ([LEAD], {}, r"axis 1: navigation.lead_s: got 0.0 with policy.kind = 'open'; needs"),
    ([], {"policy": "replan"}, r"campaign.policy: got 'replan' with do = 'plan'; needs"),
    ([LEAD], REPLANNED, r"'replan' without a measurement"),
    ([axis(LEAD_S, 0, 1e4)], REPLANNED | {"overrides": MEASURED}, "row 2: .* cut-off of burn 4"),
    ([KIND], {}, r"axis 1, row 2: policy.kind: got 'feedback' without a measurement"),
    ([LEAD], {"overrides": FEEDBACK}, r"navigation: .* must have sigma_position_m"),
    ([axis(LEAD_S, 0, 3e4)], {"overrides": CLOSED}, "row 2: .* every cut-off precedes departure"),
]


@pytest.mark.parametrize(("axes", "campaign", "words"), IDLE)
def test_what_no_case_would_do_is_refused(axes, campaign, words):
    """Rather than left out without a word."""
    with pytest.raises(InputError, match=words):
        study(*axes, **campaign)


def test_policies_and_navigation_are_axes():
    """One figure of a measurement may be swept where the other one is the same in all cases."""
    assert len(study(KIND, COST, LEAD, overrides=MEASURED).cases) == 8
    swept = study(axis("navigation.sigma_position_m", 1.0, 50.0), overrides=FEEDBACK)
    found = [changed(swept.base, case.changes, swept.folder).navigation for case in swept.cases]
    sigmas = [(one.sigma_position_m, one.sigma_velocity_m_s) for one in found]
    assert sigmas == [(1.0, 5e-4), (50.0, 5e-4)]
    assert study(LEAD, do="fly", policy="replan", overrides=MEASURED).campaign.policy == "replan"
    assert study(axis(P, 0.7), do="design").campaign.do == "design"


def test_billion_cases_are_counted_and_need_consent():
    grids = [
        {"entry": entry, "grid": {"from": 0.1, "to": 0.2, "count": 1000}}
        for entry in ("burns.dv_max_m_s", "uncertainty.execution_error", "risk.p_chance")
    ]
    begun = time.process_time()
    with pytest.raises(InputError, match=r"1,000,000,000 cases \(1,000 x 1,000 x 1,000\).*--yes"):
        study(*grids)
    with pytest.raises(InputError, match=r"axis 1.grid.count: got 1000000000; .* 1e\+06"):
        study({"entry": "risk.p_chance", "grid": {"from": 0.1, "to": 0.2, "count": 10**9}})
    assert time.process_time() - begun < 1.0


def test_the_hash_is_of_what_decides_the_rows(tmp_path):
    """Of an ephemeris too, which an entry two levels deep names."""
    table = {"boundary": {"home": {"ephemeris_file": "ring.csv"}}, "name": "x"}
    assert list(files_in(table)) == ["ring.csv"]

    def hashed(text: str) -> str:
        path = tmp_path / "study.toml"
        path.write_text(text)
        return read_study(path).hash

    one = '[campaign]\nbase = "recon_b"\n[[axis]]\nentry = "risk.p_chance"\nvalues = [0.7, 0.8]\n'
    same = one + "# a word\n"
    spelled = one.replace("values", "grid").replace(
        "[0.7, 0.8]", "{from = 0.7, to = 0.8, count = 2}"
    )
    assert hashed(one) == hashed(same) == hashed(spelled)
    refused = {"[campaign": "TOML", "[[axes]]": "did you mean axis", "[axis]": r"tables \[\[axis]]"}
    for text, said in refused.items():
        with pytest.raises(InputError, match=said):
            hashed(text)
    for other in (
        one.replace("0.8", "0.81"),
        one.replace("[[axis]]", "seed = 1\n[[axis]]"),
        one.replace("[[axis]]", "do = 'fly'\n[[axis]]"),
        one.replace("[[axis]]", 'overrides."safety.radius_min_m" = 501\n[[axis]]'),
    ):
        assert hashed(other) != hashed(one)
