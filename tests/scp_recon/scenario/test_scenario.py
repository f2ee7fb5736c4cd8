"""Scenarios: files, overrides, messages, and the JSON schema."""

import json
import re
from operator import attrgetter
from pathlib import Path
from typing import Any, get_args, get_origin

import pytest
from pydantic import BaseModel, ValidationError

from scp_recon.errors import InputError
from scp_recon.scenario.json_schema import schema_text
from scp_recon.scenario.load import Scenario, load_scenario, scenario_text
from tests import reliability
from tests.scp_recon.support import refusal


def refused(*overrides: str) -> InputError:
    error = refusal(load_scenario, None, overrides)
    reliability.count(reliability.BAD_INPUTS)
    return error


PAPER = {
    "observation.site_distance_min_m": 500.0,
    "observation.site_distance_max_m": 740.0,
    "observation.local_solar_time_min_h": 8.0,
    "observation.local_solar_time_max_h": 16.0,
    "observation.emission_min_deg": 20.0,
    "observation.emission_max_deg": 45.0,
    "observation.phase_min_deg": 10.0,
    "observation.phase_max_deg": None,
    "observation.incidence_max_deg": 60.0,
    "burns.dv_max_m_s": 0.2,
    "burns.times_s": (0.0, 8000.0, 25_000.0, 34_842.0),
    "safety.radius_min_m": 500.0,
    "risk.p_chance": 0.70,
    "uncertainty.execution_error": 0.08,
    "uncertainty.initial_sigma_fraction": 0.01,
    "site.normal_body": (0.394316, 0.565411, 0.724448),
    "grid.step_max_s": 232.0,
    "battery.delta_v_cone_deg": 23.3,
    "battery.observation_cone_deg": 18.2,
    "schedule.attitude_s": 1800.0,
    "schedule.heating_s": 1800.0,
    "schedule.recharge_s": 1200.0,
    "boundary.frame": "sun_north",
    "boundary.initial_position_m": (70.2, -1096.3, 406.4),
    "boundary.initial_velocity_m_s": (-0.0047, -0.0167, 0.0278),
    "boundary.final_position_m": (19.9, 1128.7, -140.9),
    "boundary.final_velocity_m_s": (0.0003, 0.0496, -0.0457),
    "polytopes.ball": "paper",
    "polytopes.cone": "paper",
}
"""Echigo et al., table of numerical parameters."""


def test_default_is_the_papers_table(scenario):
    assert {entry: attrgetter(entry)(scenario) for entry in PAPER} == PAPER
    assert scenario.duration_s == 34_842.0


UNITS = ("_m", "_km", "_s", "_h", "_deg", "_rad", "_kg", "_m2", "_m_s", "_km_s")
COMPOUND_UNITS = ("_m3_s2", "_w_m2", "_deg_day", "_deg_day2")
DIMENSIONLESS = {
    *("j2", "reflectivity_coefficient", "normal_body", "initial_sigma_fraction"),
    *("execution_error", "p_chance", "ball", "cone", "naif_id", "coefficients"),
    *("covariance", "planned_degree", "drift_probability"),
    "initial_covariance",
}


def numeric_entries(model: type[BaseModel]) -> list[str]:
    def holds_number(kind: Any) -> bool:
        if get_origin(kind) is None:
            return kind in (int, float)
        return any(holds_number(part) for part in get_args(kind))

    names = []
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            names += numeric_entries(field.annotation)
        elif holds_number(field.annotation):
            names.append(name)
    return names


def test_units_are_in_the_key_names():
    entries = numeric_entries(Scenario)
    assert len(entries) > 35
    for name in entries:
        assert name in DIMENSIONLESS or name.endswith(UNITS + COMPOUND_UNITS), name


def test_scenario_cannot_be_changed(scenario):
    with pytest.raises(ValidationError):
        scenario.name = "other"
    with pytest.raises(ValidationError):
        scenario.risk.p_chance = 0.9


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_a_derived_file_holds_only_what_differs(encoding, tmp_path, scenario):
    """The mark that some editors begin a file with is skipped."""
    file = tmp_path / "mine.toml"
    file.write_text('base = "recon_b"\nname = "mine"\n[risk]\np_chance = 0.8\n', encoding)
    mine = load_scenario(file)
    expected = scenario.model_dump()
    expected["name"], expected["risk"]["p_chance"] = "mine", 0.8
    assert mine.model_dump() == expected


@pytest.mark.parametrize(
    ("override", "path", "value"),
    [
        ("risk.p_chance=0.9", "risk.p_chance", 0.9),
        ("grid.step_max_s=100", "grid.step_max_s", 100.0),
        ("boundary.frame=j2000", "boundary.frame", "j2000"),
        ('boundary.frame="j2000"', "boundary.frame", "j2000"),
        ("polytopes.ball=48", "polytopes.ball", 48),
        ("polytopes.ball=tangent", "polytopes.ball", "tangent"),
        ("observation.window_s=[1e4, 1.2e4]", "observation.window_s", (1e4, 1.2e4)),
        ("burns.times_s=[0, 9000]", "burns.times_s", (0.0, 9000.0)),
        ("name=mine", "name", "mine"),
        ("body.j2=-0.01", "body.j2", -0.01),
    ],
)
def test_an_override_changes_one_entry(override, path, value, scenario):
    changed = load_scenario(None, [override])
    assert attrgetter(path)(changed) == value
    before, after = scenario.model_dump(), changed.model_dump()
    for key in path.split("."):
        assert {k for k in before if before[k] != after[k]} == {key}
        before, after = before[key], after[key]


def test_epoch_is_a_date_or_a_string(scenario):
    for text in ("2020-01-21T20:33:17.184", '"2020-01-21T20:33:17.184"'):
        assert load_scenario(None, [f"epoch.tdb={text}"]) == scenario


BAD_VALUES = [
    # override, entry, what the message shows of the value, what it says is allowed
    ("risk.p_chance=0.5", "risk.p_chance", "0.5", "0.5"),
    ("risk.p_chance=1", "risk.p_chance", "1", "at most 0.999999999"),
    ("risk.p_chance=nan", "risk.p_chance", "nan", "finite"),
    ("burns.dv_max_m_s=0", "burns.dv_max_m_s", "0", "at least 1e-09"),
    ("burns.dv_max_m_s=fast", "burns.dv_max_m_s", "'fast'", "number"),
    ('burns.dv_max_m_s="0.2"', "burns.dv_max_m_s", "'0.2'", "number"),
    ("burns.dv_max_m_s=", "burns.dv_max_m_s", "''", "number"),
    ("burns.times_s=[0, true]", "burns.times_s.1", "True", "number"),
    ("burns.times_s=[0]", "burns.times_s", "[0]", "must have at least 2 items"),
    ("burns.times_s=[0, 1e8]", "burns.times_s.1", "100000000", "at least 0 and at most 1e+07"),
    ("boundary.frame=ecliptic", "boundary.frame", "'ecliptic'", "'sun_north' or 'j2000'"),
    ("boundary.initial_position_m=[1, 2]", "boundary.initial_position_m", "[1, 2]", "have 3 items"),
    ("observation.window_s=[1]", "observation.window_s", "[1]", "must have 2 items"),
    (f"burns.times_s={list(range(70))}", "burns.times_s", "[0, 1", "must have at most 64 items"),
    ("polytopes.ball=3", "polytopes.ball", "3", "at least 4 and at most 512"),
    ("polytopes.ball=round", "polytopes.ball", "'round'", "'paper'"),
    ("polytopes.cone=true", "polytopes.cone", "True", "whole number"),
    ("epoch.tdb=tomorrow", "epoch.tdb", "'tomorrow'", "date and time"),
    ("body.gm_m3_s2=-4.9", "body.gm_m3_s2", "-4.9", "at least 1e-06 and at most 1e+20"),
    ("observation.emission_max_deg=90", "observation.emission_max_deg", "90", "less than 90"),
    ("observation.window_s=[1, x]", "observation.window_s", "[1, x]", "list"),
    ("uncertainty.execution_error=1e-300", "uncertainty.execution_error", "1e-300", "1e-09"),
    ("uncertainty.execution_error=1", "uncertainty.execution_error", "1", "less than 1"),
    ("site.normal_body=[1e-320, 0, 0]", "site.normal_body", "1e-320", "shorter than 0.001"),
    ("sun.body_position_km=[1e308, 0, 0]", "sun.body_position_km.0", "1e+308", "at most 1e+12"),
    ('name=""', "name", "''", "not empty"),
    (f"name={201 * 'x'}", "name", "xxx", "at most 200 characters"),
    ('name="a\\u001b[31m"', "name", r"'a\x1b[31m'", "printable"),
    ("body=5", "body", "5", "table"),
    ("uncertainties.execution_error=0.1", "uncertainties", "unknown", "did you mean uncertainty?"),
    ("burns.dv_max=0.1", "burns.dv_max", "unknown", "dv_max_m_s? (units are part of the key)"),
    ("risk.p_chanse=0.8", "risk.p_chanse", "unknown", "p_chance"),
    ("burns.dv_max_mm_s=200", "burns.dv_max_mm_s", "unknown", "dv_max_m_s"),
    ("safty.radius_min_m=500", "safty", "unknown", "safety"),
    ("xyzzy=1", "xyzzy", "unknown", "observation"),  # nothing is near: all are listed
    ("risk.xyzzy=1", "risk.xyzzy", "unknown", "p_chance"),
    # A table where a value belongs.
    ("risk.p_chance.more=0.8", "risk.p_chance", "more", "number"),
    ("burns.times_s.1=8000", "burns.times_s", "1", "list"),
    # Values that are each fine and do not go together, or that the type alone does not refuse.
    ("burns.times_s=[0, 25000, 8000, 34842]", "burns.times_s", "8000", "ascending"),
    ("burns.times_s=[5, 8000, 25000, 34842]", "burns.times_s", "5", "start at 0"),
    ("observation.emission_min_deg=50", "observation", "50", "below"),
    ("observation.site_distance_max_m=500", "observation", "500", "below"),
    ("epoch.tdb=2020-01-21T20:33:17Z", "epoch.tdb", "2020-01-21", "no time zone"),
    ("site.normal_body=[0, 0, 0]", "site.normal_body", "0, 0", "must not"),
    ("sun.body_position_km=[0, 0, 0]", "sun.body_position_km", "0, 0", "must not"),
]


@pytest.mark.parametrize(
    ("override", "entry", "shown", "allowed"), BAD_VALUES, ids=[case[0] for case in BAD_VALUES]
)
def test_a_bad_value_is_named_shown_and_answered(override, entry, shown, allowed):
    error = refused(override)
    assert error.entry == entry
    assert shown in (error.allowed if error.given == "these values" else error.given)
    assert allowed in error.allowed
    assert str(error).startswith(f"{entry}: got ")
    assert not re.search("Tuple|String|Input|validation|valid ", str(error))  # the library's words


def test_problems_are_listed_together_up_to_five():
    error = refused("risk.p_chance=2", "grid.step_max_s=0", "schedule.attitude_s=-1")
    for entry in ("risk.p_chance", "grid.step_max_s", "schedule.attitude_s"):
        assert entry in str(error)
    alone = refused("burns.times_s=[0, true]")  # and not that one item is too few as well
    assert len(str(alone).splitlines()) == 1
    many = refused(*(f"risk.unknown_{i}=1" for i in range(30)))
    assert len(str(many).splitlines()) < 10


@pytest.mark.parametrize(
    "override",
    [
        *("risk.p_chance", "=0.8", ".=1", "risk.=1", ".p=1", "", "a.b.c.d.e=1", "name=a\tb"),
        "risk.p_chance=0.8\nburns.dv_max_m_s=0.1",
    ],
)
def test_a_malformed_override_is_refused(override):
    error = refused(override)
    assert error.entry == "overrides"
    assert repr(override) in error.given
    assert "section.entry=value" in error.allowed


@pytest.mark.parametrize(
    "value",
    ["1" * 400, "1" * 5000, "1e999", "0x" + "f" * 5000, "[" * 5000, "{a=" * 2000, "9999-99-99"],
    ids=["400 digits", "5000 digits", "1e999", "hexadecimal", "brackets", "tables", "no date"],
)
def test_monstrous_values_end_in_an_input_error(value):
    assert len(str(refused(f"burns.dv_max_m_s={value}"))) < 400


def test_numbers_may_stand_in_one_long_line(tmp_path):
    times = [0.5 * i for i in range(1000)]
    text = 'base = "recon_b"\n[grid]\nnodes_s = [{}]\n'
    for separator in (", ", ",\n", ","):
        (tmp_path / "mine.toml").write_text(text.format(separator.join(map(repr, times))), "utf-8")
        assert load_scenario(tmp_path / "mine.toml").grid.nodes_s == tuple(times)
    file = tmp_path / "written.toml"
    file.write_text(scenario_text(load_scenario(tmp_path / "mine.toml")), "utf-8")
    assert load_scenario(file).grid.nodes_s == tuple(times)


HEAD = 'base = "recon_b"\n'
SOLUTION = '{"schema": "scp_recon.solution/2",\n"nodes": [[' + "0.5, " * 300 + "1.0]]}"
BAD_FILES: dict[str, tuple[str | bytes, str, str]] = {
    # what is in the file, what the message's entry begins with, words of the message
    "part": ("[risk]\np_chance = 0.8\n", "name", "(or name a base)"),
    "empty": ("", "scenario", 'have base = "recon_b"'),
    "solution": (SOLUTION, "scenario {}", "got JSON.*--init"),
    "text": (b"this is not = = TOML", "scenario {}", "must be a scenario file"),
    "binary": (b"\x00\x01\xff\xfe\x80", "scenario {}", "must be a scenario file"),
    "picture": (b"\x89PNG\r\n\x1a\n", "scenario {}", "must be a scenario file"),
    "other JSON": (b'{"name": 1}', "scenario {}", "must be a scenario file"),
    "brackets": ("x = " + "[" * 5000, "scenario {}", ""),
    "5000 digits": ("x = " + "1" * 5000, "scenario {}", ""),
    "no table": (HEAD + "risk = 0.8\n", "risk", "0.8"),
    "a megabyte": (HEAD + "#" * 1_000_000, "scenario {}", "more than 1 megabytes"),
    "many keys": (HEAD + "\n".join(f"k{i} = 1" for i in range(10_000)), "k0", "and 9995 more"),
    "a deep key": (HEAD + "a" + ".a" * 100_000 + " = 1", "scenario {}", "a line of many dots"),
    "a deep key of numbers": (HEAD + "1" + ".1" * 100_000 + " = 1", "scenario {}", "many dots"),
    "a deep list": (f"{HEAD}x = {400 * '['}{400 * ']'}", "scenario", "nested a few levels deep"),
}


@pytest.mark.slow
@pytest.mark.timeout(10)
@pytest.mark.parametrize(("content", "entry", "words"), BAD_FILES.values(), ids=BAD_FILES)
def test_a_bad_file_is_refused_at_once(tmp_path, content, entry, words):
    file = tmp_path / "bad.toml"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    error = refusal(load_scenario, file)
    assert error.entry == entry.format(file)
    assert re.search(words, str(error), re.DOTALL)


PUBLISHED = Path(__file__).parents[3] / "docs" / "scenario.schema.json"


def test_it_is_up_to_date():
    assert PUBLISHED.read_text("utf-8") == schema_text(), (
        "run python -m scp_recon schema docs/scenario.schema.json"
    )


def test_schema_describes_every_entry_and_no_other():
    published = json.loads(PUBLISHED.read_text("utf-8"))
    for name, table in {"the file": published, **published["definitions"]}.items():
        assert table["additionalProperties"] is False
        assert "required" not in table  # a base may give it
        for key, entry in table["properties"].items():
            assert len(entry.get("description", "")) > 5, f"{name}.{key}"
