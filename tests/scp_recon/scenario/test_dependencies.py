"""What a file inherits from its base, and which missing entries are reported."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from scp_recon.errors import InputError
from scp_recon.scenario.given import DERIVED
from scp_recon.scenario.load import load_scenario, validate_scenario
from scp_recon.scenario.schema import Scenario
from tests.scp_recon.scenario.test_resolution import PLACE, rock
from tests.scp_recon.support import refusal


def test_the_documented_example_loads(tmp_path):
    page = (Path(__file__).parents[3] / "docs" / "scenario.md").read_text("utf-8")
    (tmp_path / "mine.toml").write_text(page.split("```toml\n")[1].split("```")[0], "utf-8")
    found = load_scenario(tmp_path / "mine.toml")
    assert (found.name, found.site.latitude_deg) == ("next_year", 50.0)


def chain(folder: Path, *texts: str) -> Path:
    """Files that are each the base of the next; the last one."""
    for number, text in enumerate(texts):
        base = "recon_b" if number == 0 else f"{number - 1}.toml"
        (folder / f"{number}.toml").write_text(f'base = "{base}"\n{text}', "utf-8")
    return folder / f"{len(texts) - 1}.toml"


def test_a_base_may_be_ones_own_file(tmp_path, monkeypatch):
    (tmp_path / "a").mkdir()
    chain(tmp_path / "a", "[risk]\np_chance = 0.8\n", "[grid]\nstep_max_s = 100.0\n")
    (tmp_path / "top.toml").write_text('base = "a/1.toml"\nname = "top"\n', "utf-8")
    monkeypatch.chdir("/")
    found = load_scenario(tmp_path / "top.toml")
    assert (found.name, found.risk.p_chance, found.grid.step_max_s) == ("top", 0.8, 100.0)


@pytest.mark.parametrize(
    "base", ['"1.toml"', '"./0.toml"', '"no.toml"', '"/"', '""', "5", "[1]", '"a\\nb"']
)
def test_a_base_that_is_none_is_refused(base, tmp_path):
    last = chain(tmp_path, "", "")
    (tmp_path / "0.toml").write_text(f"base = {base}\n", "utf-8")
    error = refusal(load_scenario, last)
    assert error.entry == "base"


def test_bases_come_to_an_end(tmp_path):
    assert load_scenario(chain(tmp_path, *[""] * 8))
    with pytest.raises(InputError, match="8 files at most"):
        load_scenario(chain(tmp_path, *[""] * 12))


@given(latitude=st.floats(-80.0, 80.0), other=st.floats(-80.0, 80.0))
def test_inherited_site_follows_its_coordinates(latitude, other):
    assume(abs(latitude - other) > 1e-3)
    first = rock(site=PLACE | {"latitude_deg": latitude})
    second = first.replace({"site.latitude_deg": other})
    assert second == rock(site=PLACE | {"latitude_deg": other})
    # A position without a normal has the surface's, and not the base's.
    third = first.replace({"site.position_body_m": list(second.site.position_body_m)})
    np.testing.assert_allclose(third.site.normal_body, second.site.normal_body, atol=1e-9)
    assert third.site.latitude_deg is None


def test_another_body_inherits_nothing_of_the_first():
    error = refusal(load_scenario, None, ["body.name=Rock"])
    told = str(error)
    for entry in ("body.gm_m3_s2", "body.pole_ra_deg", "sun.body_position_km", "site.normal_body"):
        assert entry in told
    assert "risk.p_chance" not in told


def test_all_missing_entries_are_told_at_once():
    error = refusal(validate_scenario, {"name": "empty", "risk": {}})
    told = str(error).splitlines()[0]
    for table, field in Scenario.model_fields.items():
        for key, entry in getattr(field.annotation, "model_fields", {}).items():
            assert (f"{table}.{key}" in told) == entry.is_required(), f"{table}.{key}"


@pytest.mark.parametrize(
    "wrong",
    ["epoch.tdb=2021-03-14T06:00:00Z", "body.pole_dec_deg=100.0", "site.latitude_deg=95.0"],
)
def test_derivable_entries_are_not_called_missing(wrong):
    """It is computed once that is right."""
    error = refusal(load_scenario, None, [wrong, "site.longitude_deg=10.0"])
    assert error.entry == wrong.partition("=")[0]
    assert "missing" not in str(error)


def test_missing_entries_are_listed_beside_a_wrong_one():
    tables = load_scenario().model_dump(mode="json", exclude_none=True)
    tables["epoch"]["tdb"] = "tomorrow"
    del tables["sun"], tables["risk"]["p_chance"]
    with pytest.raises(InputError, match=r"missing: risk\.p_chance"):
        validate_scenario(tables)


def test_derived_entries_exist_in_the_schema():
    for table, names in DERIVED.items():
        model = Scenario.model_fields[table].annotation
        assert {name.partition(".")[2] for name in names} <= model.model_fields.keys()
