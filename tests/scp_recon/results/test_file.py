"""The solution file: complete, read back as written, whole or not at all."""

import json
import math
from dataclasses import replace
from datetime import datetime, timedelta
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from scp_recon.errors import InputError
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess
from scp_recon.planning.planner import plan
from scp_recon.results.read import read_solution
from scp_recon.results.solution import SCHEMA, Solution, make_solution
from scp_recon.scenario.load import validate_scenario
from scp_recon.verification.reintegration import verify
from tests import reliability
from tests.helpers import usually
from tests.scenarios import COARSE
from tests.scp_recon.support import mission_of, numbers, with_value

Data = dict[str, Any]


@pytest.fixture(scope="module")
def solution() -> Solution:
    """On half of the nodes: a file half as long, which is read many times."""
    mission = mission_of(COARSE)
    return make_solution(plan(mission, initial_guess.cold(mission)))


@pytest.fixture(scope="module")
def verified(solution) -> Solution:
    checked = verify(Mission.from_scenario(solution.scenario), solution)
    return replace(solution, verification=checked)


@pytest.fixture(scope="module")
def data(verified, tmp_path_factory) -> Data:
    path = verified.write(tmp_path_factory.mktemp("written"))
    parsed: Data = json.loads(path.read_text("utf-8"))
    return parsed


def test_round_trip_through_file_and_folder(solution, verified, tmp_path):
    for version in (solution, verified):
        path = version.write(tmp_path)
        assert path == tmp_path / "solution.json"
        assert read_solution(path) == version
        assert read_solution(tmp_path) == version


def test_unknown_keys_of_later_versions_are_ignored(data, tmp_path):
    (tmp_path / "solution.json").write_text(json.dumps(data | {"note": "added later"}), "utf-8")
    read = read_solution(tmp_path)
    assert read.verification.ok
    assert not read.warnings


@pytest.mark.parametrize("path", ["burns.0.dv_m_s.0", "scenario.risk.p_chance"])
def test_an_edited_plan_is_read_as_not_verified(data, tmp_path, path):
    assert data["verification"]["ok"]
    (tmp_path / "solution.json").write_text(edited(data, path, 0.6), "utf-8")
    read = read_solution(tmp_path)
    assert not read.verification.ok
    assert read.verification.failed == ["plan_hash"]
    assert "changed after" in str(read.warnings[-1])


def other(value: object) -> object:
    """A value next to one of the scenario's; of any number the next one."""
    match value:
        case float():
            return math.nextafter(value, math.inf)
        case int():
            return value + 1
        case "paper":
            return 5
        case "sun_north":
            return "j2000"
        case str():
            return f"{value}x"
        case datetime():
            return value + timedelta(microseconds=1)
        case ():
            return (1.0,)
        case (first, *rest):
            return (other(first), *rest)
    raise TypeError(value)


def test_plan_hash_covers_every_entry_and_bit(solution, verified):
    """And nothing besides them."""
    others = {"message": "", "iterations": [], "stages": [], "init": "x"}
    timing = replace(solution.timing_s, total=1.0)
    same = replace(solution, **others, timing_s=timing)
    assert {s.plan_hash for s in (verified, same)} == {solution.plan_hash}
    scenario, found = solution.scenario, [solution.plan_hash]
    for name, section in scenario:
        if isinstance(section, str):
            copies = [other(section)]
        elif section is None:  # nor is it under way
            continue
        else:
            given = {key: other(value) for key, value in section if value is not None}
            copies = [section.model_copy(update={key: value}) for key, value in given.items()]
        for changed in copies:
            whole = scenario.model_copy(update={name: changed})
            found.append(replace(solution, scenario=whole).plan_hash)
    for at, axis in np.ndindex(len(solution.burns), 3):
        burns, dv = list(solution.burns), list(solution.burns[at].dv_m_s)
        dv[axis] = math.nextafter(dv[axis], math.inf)
        burns[at] = replace(burns[at], dv_m_s=tuple(dv))
        found.append(replace(solution, burns=burns).plan_hash)
    assert len(set(found)) == len(found) > 50


def test_others_may_read_the_file_as_any_other(solution, tmp_path):
    """A result is shared: its permissions are those of every file made here."""
    ordinary = tmp_path / "ordinary"
    ordinary.write_text("", "utf-8")
    assert solution.write(tmp_path).stat().st_mode == ordinary.stat().st_mode


def refused(file: Path, content: str | bytes) -> InputError:
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as caught:
        read_solution(file)
    assert str(file) in caught.value.entry
    reliability.count(reliability.BAD_INPUTS)
    return caught.value


NO_JSON = [b"", b"{", b"\x89PNG\r\n\x1a\n", b"\xff\xfe\x00", b"nonsense", b"[" * 100_000]
OTHER = [b"[]", b"5", b"null", b'"text"', b"{}", b'{"schema": 1}']


@pytest.mark.parametrize(
    ("content", "words"),
    [
        *((content, "JSON") for content in NO_JSON),
        *((content, SCHEMA) for content in (*OTHER, b'{"schema": "scp_recon.solution/3"}')),
    ],
    ids=lambda given: str(given[:35]),
)
def test_other_json_or_schema_is_refused(tmp_path, content, words):
    assert words in str(refused(tmp_path / "s.json", content))


def edited(data: Data, path: str, value: object) -> str:
    where = [int(key) if key.isdigit() else key for key in path.split(".")]
    return json.dumps(with_value(data, tuple(where), value))


@pytest.mark.slow
@pytest.mark.parametrize(
    "path",
    [
        *("status", "burns", "nodes", "nodes.state", "scenario", "scenario.risk.p_chance"),
        *("total_dv_m_s", "timing_s", "violation.total", "stages.0.name", "verification"),
    ],
)
def test_a_missing_key_is_named(tmp_path, data, path):
    error = refused(tmp_path / "s.json", edited(data, path, ...))
    assert path in error.entry
    assert error.given == "nothing"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "value"),
    usually(
        [
            ("status", "splendid"),
            ("status", 5),
            ("problem", "P1"),
            ("total_dv_m_s", "much"),
            ("total_dv_m_s", float("nan")),
            ("burns.0.dv_m_s", [1.0, 2.0]),
            ("burns.0.dv_m_s.1", float("inf")),
            ("burns.0.t_s", None),
            ("nodes.state", "none"),
            ("nodes.state.3.2", "x"),
            ("scenario.risk.p_chance", 1.5),
            ("scenario.burns.times_s", [0.0, 9.0, 3.0]),
            ("scenario.unknown", 1),
            ("primer.legal", [True]),
            ("primer.residual", -1.0),
            ("primer.allowed", ["1"]),
            *(("verification.ok", value) for value in (1, 0, "yes")),
            *(("iterations.0.accepted", value) for value in (1, 0, "yes")),
            *(
                (f"verification.probabilities.0.{key}", value)
                for key in ("estimate", "low", "high")
                for value in (-1e-9, 1.0 + 1e-9)
            ),
            # Parts that do not fit together: whoever works with what was read may rely on its shapes.
            ("nodes.state.5", ...),  # a node less than times
            ("nodes.state.5", [1.0, 2.0, 3.0]),  # a state without a velocity
            ("nodes.covariance.5", ...),
            ("nodes.covariance.5.2", ...),
            ("nodes.covariance.5.2", [1.0]),
            ("nodes.t_s.5", ...),
            ("nodes.t_s.5", 0.0),  # not ascending
            ("nodes", {"t_s": [], "state": [], "covariance": []}),
            *(("burns", []), ("burns.2", ...)),  # fewer than firing times
        ],
        20,
    ),
)
def test_a_bad_value_is_named(tmp_path, data, path, value):
    error = refused(tmp_path / "s.json", edited(data, path, value))
    assert path.split(".", maxsplit=1)[0] in error.entry + error.allowed


def test_every_number_is_a_number(tmp_path, data):
    """Neither a boolean nor a string nor a list."""
    places = list(numbers(data))
    assert len(places) > 80
    for where, value in zip(
        usually(places[::5] + places, 25), cycle([True, "1", False, [1.0]]), strict=False
    ):
        error = refused(tmp_path / "s.json", json.dumps(with_value(data, where, value)))
        assert str(where[0]) in error.entry


def window_edge(data: Data) -> int:
    """The node at the second edge of the observation window, which is found by a root search."""
    mission = Mission.from_scenario(validate_scenario(data["scenario"]))
    return int(mission.window_nodes[-1])


def with_time(data: Data, part: str, at: int, error_s: float) -> str:
    times = data["nodes"]["t_s"] if part == "nodes" else [b["t_s"] for b in data["burns"]]
    path = f"nodes.t_s.{at}" if part == "nodes" else f"burns.{at}.t_s"
    return edited(data, path, times[at] + error_s)


@pytest.mark.usefixtures("few_flights")
@pytest.mark.parametrize("error_s", [1e-9, -1e-9, 0.9e-3])
def test_another_machines_window_edge_is_verified(tmp_path, data, error_s):
    file = tmp_path / "s.json"
    file.write_text(with_time(data, "nodes", window_edge(data), error_s), "utf-8")
    read = read_solution(file)
    assert read.nodes.t_s != data["nodes"]["t_s"]
    assert verify(Mission.from_scenario(read.scenario), read).failed == []


def test_times_off_the_scenarios_grid_are_refused(tmp_path, data):
    last, edge = len(data["nodes"]["t_s"]) - 1, window_edge(data)
    for part, at, error_s in (
        *(("nodes", edge, error_s) for error_s in (1.0, -1.0, 1.1e-3)),
        *(("burns", at, 1e-9) for at in (1, 0)),
        *(("nodes", at, 1e-9) for at in (0, last)),
    ):
        error = refused(tmp_path / "s.json", with_time(data, part, at, error_s))
        assert f"{part}.t_s" in error.entry
