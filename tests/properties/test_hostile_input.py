"""Any input ends in a result or in one message; and nothing else is read or written.

Ten examples of each campaign in usual runs, all of them in the nightly profile.
"""

import contextlib
import copy
import io
import json
import math
import sys
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from datetime import date, datetime
from functools import reduce
from importlib.resources import files
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from scp_recon.advice import infeasibility, trials
from scp_recon.api import planning
from scp_recon.cli.commands import montecarlo, simulate, solve, verify
from scp_recon.errors import InputError
from scp_recon.interop.ccsds import oem_track
from scp_recon.mission.mission import Mission
from scp_recon.planning import initial_guess, planner
from scp_recon.results.read import read_solution
from scp_recon.results.solution import make_solution
from scp_recon.scenario.load import load_scenario
from scp_recon.scp.algorithms import ALGORITHMS, SCvx
from tests import reliability
from tests.helpers import MANY, share_of_examples, usually
from tests.scenarios import COARSE
from tests.scp_recon.support import fly_few, status_of

RECON_B: dict[str, Any] = tomllib.loads(
    (files("scp_recon") / "data" / "recon_b.toml").read_text("utf-8")
)
patient = settings(
    max_examples=share_of_examples(1, usual=10),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)


numbers = (
    st.sampled_from([0, -0.0, -1, 1, 5e-324, 1e-300, 1e308, -1e308, 10**18, 2**63])
    | st.sampled_from([math.nan, math.inf, -math.inf])
    | st.floats()
)
words = st.sampled_from(
    ["", " ", "nan", "1e3", "recon_b", "../../etc/passwd", "/dev/zero", "$(id)", "__import__('os')"]
) | st.text(max_size=20)
plain = numbers | words | st.booleans()
moments = st.just(datetime(2020, 1, 21, 20, 33, 17)) | st.just(date(2020, 1, 21))
hostile = st.recursive(
    plain | moments,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(words, inner, max_size=3),
    max_leaves=6,
)


def places(data: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Every place in nested tables and lists."""
    items = data.items() if isinstance(data, dict) else enumerate(data)
    for key, value in items:
        yield (*path, key)
        if isinstance(value, dict | list):
            yield from places(value, (*path, key))


@st.composite
def damaged(draw: st.DrawFn, original: dict[str, Any], values: st.SearchStrategy[Any]) -> Any:
    """One to three entries replaced, wrapped, dropped, doubled or added."""
    data = copy.deepcopy(original)
    for _ in range(draw(st.integers(1, 3))):
        where = draw(st.sampled_from(list(places(data))))
        inside: Any = data
        for key in where[:-1]:
            inside = inside[key]
        last = where[-1]
        how = draw(st.sampled_from(["replace", "replace", "replace", "wrap", "drop", "add"]))
        if how == "replace":
            inside[last] = draw(values)
        elif how == "wrap":
            inside[last] = draw(st.sampled_from([[inside[last]], {"value": inside[last]}]))
        elif how == "drop":
            del inside[last]
        elif isinstance(inside, dict):
            inside[draw(words)] = draw(values)
        else:
            inside.append(draw(values))
        if not data:
            break
    return data


def toml(value: Any) -> str:
    """A value, inline; TOML has no null, and ours draw none."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, dict):
        return "{" + ", ".join(f"{toml(str(k))} = {toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, datetime | date):
        return value.isoformat()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)


def document(data: dict[str, Any]) -> str:
    return "\n".join(f"{toml(key)} = {toml(value)}" for key, value in data.items())


TOUCHED: list[tuple[str, Any]] | None = None
WATCHED = ("open", "os.system", "subprocess.Popen", "os.exec", "os.posix_spawn", "os.fork", "exec")
WATCHED += ("os.remove", "os.rename", "os.mkdir", "os.link", "os.symlink", "socket.connect")


def hook(event: str, arguments: tuple[Any, ...]) -> None:
    if TOUCHED is not None and event in WATCHED:
        TOUCHED.append((event, arguments))


sys.addaudithook(hook)
with contextlib.suppress(InputError):  # Pydantic loads its modules of JSON schemas with the first
    load_scenario(None, ["risk.p_chance=2"])


@contextlib.contextmanager
def watched() -> Iterator[list[tuple[str, Any]]]:
    """Everything that Python opens, runs, makes, moves or removes meanwhile."""
    global TOUCHED
    TOUCHED = touched = []
    try:
        yield touched
    finally:
        TOUCHED = None


PACKAGE = Path(str(files("scp_recon"))).resolve()
LIBRARIES = (Path(sys.prefix).resolve(), Path(sys.base_prefix).resolve(), PACKAGE.parent)


def assert_touched_only(touched: list[tuple[str, Any]], *allowed: Path) -> None:
    """Only what was named, and the libraries' own files for reading."""
    for event, arguments in touched:
        assert event in ("open", "os.remove", "os.rename", "os.mkdir"), (event, arguments)
        path = arguments[0]
        if isinstance(path, int) or arguments[-1] is None:
            continue
        at = Path(str(path)).resolve()
        if any(at.is_relative_to(place) for place in allowed):
            continue
        writes = event != "open" or set("wxa+") & set(str(arguments[1] or "r"))
        assert not writes, (event, arguments)
        assert any(at.is_relative_to(place) for place in LIBRARIES), (event, arguments)


def read_or_refuse(read: Callable[[], object]) -> None:
    """A result, or an error of the user's whose message is short and printable."""
    try:
        read()
    except InputError as error:
        message = str(error)
        assert message
        assert len(message) < 3000
        assert message.replace("\n", "").isprintable()  # no control sequence for the terminal
        reliability.count(reliability.BAD_INPUTS)


@contextlib.contextmanager
def file_with(content: bytes | str, name: str = "solution.json") -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder).resolve() / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        yield path


def read_alone(content: bytes | str, read: Callable[[Path], object], *allowed: str | Path) -> None:
    """A file is read or refused, and nothing else is touched but what is allowed beside it."""
    with file_with(content) as path:
        with watched() as touched:
            read_or_refuse(lambda: read(path))
        assert_touched_only(touched, path, *((path.parent / name).resolve() for name in allowed))


def mission_of(path: Path) -> None:
    mission = Mission.from_scenario(load_scenario(path))
    assert mission.problem.n_nodes >= 2


@pytest.mark.slow
@patient
@given(damaged(RECON_B, hostile))
def test_a_damaged_scenario_is_read_or_refused(data):
    tomllib.loads(document(data))  # what is refused is the content and not our writing
    read_alone(document(data), mission_of)


bytes_of_files = st.one_of(
    st.binary(max_size=200),
    st.text(max_size=200).map(lambda text: text.encode("utf-8", "surrogatepass")),
    st.sampled_from(["utf-16", "utf-32", "utf-8-sig", "utf-7", "cp037"]).map(
        lambda name: document(RECON_B).encode(name)
    ),
    st.integers(0, 2000).map(lambda n: document(RECON_B).encode()[:n]),
    st.sampled_from([b"", b"\n" * 1000, b"[" * 5000, b"a=" + b"[" * 5000, b"\x00", b'base = "']),
    st.sampled_from([b"x = " + b"1" * 5000, b'"' + b"k" * 10**5 + b'" = 1', b"[a]\n[a]\n"]),
    st.sampled_from(
        [b"base='recon_b'\nx=" + b"[" * 400 + b"]" * 400, b"a" + b".a" * 10**5 + b"=1"]
    ),
)


cells = st.sampled_from(["0", "1", "nan", "inf", "1e308", "-1e308", "", "x", "40000", '"', "\x00"])
tables = st.lists(st.lists(cells, min_size=6, max_size=8).map(",".join), max_size=5).map(
    lambda rows: "\n".join(["t,x,y,z,vx,vy,vz", *rows]).encode()
)
oem_lines = st.sampled_from(
    [
        *("META_START", "META_STOP", "COVARIANCE_START", "COVARIANCE_STOP", "COMMENT x", "", "="),
        *("REF_FRAME = EME2000", "TIME_SYSTEM = UTC", "TIME_SYSTEM = TDB", "CENTER_NAME = BENNU"),
        *(
            "EPOCH = 2020-01-01T00:00:00",
            "REF_FRAME_EPOCH = 2000-01-01T12:00:00",
            "1",
            "1 2",
            "x y",
        ),
        *(
            f"{day} 1 2 3 4 5 6"
            for day in ("2020-01-01T00:00:00", "2020-366T23:59:60.5Z", "0000-001")
        ),
        *("1000-01-01T00:00:00 1 2 3 4 5 6", "8999-366T00:00:00Z 1 2 3 4 5 6", "2020-999T0:0:0 1"),
    ]
)
oems = st.tuples(
    st.sampled_from(
        ["CCSDS_OEM_VERS = 2.0", "\ufeff\n CCSDS_OEM_VERS = 3.0", "<oem version='2.0'>"]
    ),
    st.lists(oem_lines, max_size=12),
).map(lambda parts: "\n".join([parts[0], "META_START", *parts[1]]).encode())
MISSION = Mission.from_scenario(load_scenario(None, [COARSE]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("read", "contents"),
    [
        (mission_of, bytes_of_files),
        (read_solution, bytes_of_files),
        (lambda path: initial_guess.from_table(MISSION, path), bytes_of_files | tables),
        (lambda path: oem_track(path, "Bennu"), bytes_of_files | oems),
    ],
    ids=["scenario", "solution", "guess", "OEM"],
)
@patient
@given(st.data())
def test_any_bytes_are_read_or_refused(read, contents, data):
    read_alone(data.draw(contents), read)


@patient
@given(st.lists(words | hostile.map(str), max_size=3), words)
def test_base_is_the_named_file_alone(values, name):
    content = document({"base": values if values else name, "name": name or "x"})
    named = [] if values or "\0" in name else [name]
    read_alone(content, load_scenario, PACKAGE / "data", *named)


entries = st.sampled_from([".".join(map(str, where)) for where in places(RECON_B)]) | words


@patient
@given(st.lists(st.tuples(entries, hostile), min_size=1, max_size=3))
def test_any_override_gives_mission_or_message(changes):
    overrides = [f"{entry}={toml(value)}" for entry, value in changes]
    read_or_refuse(lambda: Mission.from_scenario(load_scenario(None, overrides)).problem)


magnitudes = st.builds(
    lambda sign, decade: sign * 10.0**decade, st.sampled_from([1, -1]), st.floats(-12.0, 12.0)
)
"""Most of which the schema lets pass where the sign fits."""
VERY_COARSE = "grid.step_max_s=3000.0"
numeric = [
    (".".join(map(str, where)), value)
    for where in places(RECON_B)
    if isinstance(value := reduce(lambda inside, key: inside[key], where, RECON_B), float | list)
    and isinstance(where[-1], str)
]


@st.composite
def strained(draw: st.DrawFn) -> str:
    """An override by numbers of the right kind and of any size, or scaled ones."""
    entry, value = draw(st.sampled_from(numeric))
    if draw(st.booleans()):
        factor = draw(magnitudes)
        changed = [x * factor for x in value] if isinstance(value, list) else value * factor
    else:
        changed = [draw(magnitudes) for _ in value] if isinstance(value, list) else draw(magnitudes)
    return f"{entry}={changed}"


def solved_or_refused(overrides: list[str], *options: str) -> None:
    """One of the documented ends, after four iterations a stage; for bad input nothing is written.

    Usual runs have one start and facets chosen once; nightly ones have as many as the command.
    """
    sets = [argument for override in overrides for argument in ("--set", override)]
    if settings().max_examples < MANY:
        sets += ["--starts", "1", "--facet-rounds", "0"]
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        patch.setitem(ALGORITHMS, "scvx", lambda **given: SCvx(**given | {"max_iterations": 4}))
        patch.setattr(trials, "CLOSE", 1.0)
        patch.setattr(infeasibility, "TIMES", 0.0)
        patch.setattr(infeasibility, "LEAST_S", 0.5)
        patch.setattr(planning, "REFINEMENTS", 2)
        fly_few(patch)
        code = command(solve.main, [*options, *sets, "--out", folder])
        assert code in (0, 2, 3, 4)
        assert (Path(folder) / "solution.json").exists() == (code != 2)
    if code == 2:
        reliability.count(reliability.BAD_INPUTS)


slow = settings(
    patient, max_examples=share_of_examples(5, usual=2), phases=set(Phase) - {Phase.shrink}
)


@pytest.mark.slow
@slow
@given(st.lists(strained(), min_size=1, max_size=3))
def test_any_magnitudes_give_plan_or_message(overrides):
    solved_or_refused([VERY_COARSE, *overrides])


@slow
@given(damaged(RECON_B | {"grid": {"step_max_s": 3000.0}}, hostile | magnitudes))
def test_a_damaged_scenario_is_solved_or_refused(data):
    with file_with(document(data), "mine.toml") as path:
        solved_or_refused([], "--scenario", str(path))


AT_THE_ENDS = [
    *("risk.p_chance=0.999999999", "grid.step_max_s=1e7", "body.gm_m3_s2=1e-6"),
    *("body.gm_m3_s2=1e4", "safety.radius_min_m=1e12", "uncertainty.initial_sigma_fraction=0.999"),
    *("spacecraft.mass_kg=1e-9", "boundary.initial_velocity_m_s=[1e6, 1e6, 1e6]"),
    *("site.position_body_m=[1e12, 0.0, 0.0]", "sun.body_position_km=[1e12, 1e12, 1e12]"),
    "boundary.final_position_m=[1e12, 1e12, 1e12]",
]


@pytest.mark.slow
@pytest.mark.parametrize("override", usually(AT_THE_ENDS, 3))
def test_scenario_at_range_ends_is_solved_or_refused(override):
    solved_or_refused([VERY_COARSE, override])


@pytest.fixture(scope="module")
def solved(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("solved")
    mission = Mission.from_scenario(load_scenario(None, ["grid.step_max_s=3000.0"]))
    found = planner.plan(mission, initial_guess.cold(mission))
    make_solution(found).write(folder)
    return folder


@pytest.mark.slow
@patient
@given(st.data())
def test_a_damaged_solution_is_read_or_refused(solved, data):
    original = json.loads((solved / "solution.json").read_text("utf-8"))
    content = data.draw(damaged(original, plain | st.none() | st.lists(plain, max_size=3)))
    read_alone(
        json.dumps(content), lambda path: Mission.from_scenario(read_solution(path).scenario)
    )


markup = st.sampled_from(["[/red]", "[bold]", "[/]", "[link=http://x]y", "[", "\\[", ":smile:"])
huge = st.sampled_from([10**30, -(10**30), 2**64])
SHOWN = ("burns", "nodes", "total_dv_m_s", "status", "problem", "message", "facets", "stages")
SHOWN += ("constraints", "violation", "units", "scenario", "timing_s")


def with_a_word_as_key(content: dict[str, Any], word: str) -> None:
    """A violated constraint of that name, which is shown."""
    content["violation"]["by_constraint"][word] = {"max": 1.0, "total": 1.0, "unit": "m"}


@pytest.mark.slow
@settings(patient, max_examples=share_of_examples(3, usual=5))
@given(st.data())
def test_a_damaged_solution_is_verified_or_refused(solved, data):
    """And never confirmed where a number of the plan was changed."""
    original = json.loads((solved / "solution.json").read_text("utf-8"))
    part = data.draw(st.sampled_from(SHOWN))
    content = original | data.draw(damaged({part: original[part]}, plain | markup | huge))
    if data.draw(st.booleans()) and content["violation"] == original["violation"]:
        content = copy.deepcopy(content)
        with_a_word_as_key(content, data.draw(markup))
    with file_with(json.dumps(content)) as path, pytest.MonkeyPatch.context() as patch:
        fly_few(patch)
        code = command(verify.main, [str(path.parent)])
    assert code in (0, 2, 4)
    confirmed = ("total_dv_m_s", "status", "violation", "units", "nodes", "burns")
    if any(content.get(key) != original[key] for key in confirmed):
        assert code != 0
    reliability.count(reliability.BAD_INPUTS)


EDITS: dict[str, Callable[[dict[str, Any]], object]] = {
    "a node beyond all": lambda s: s["facets"]["node"].__setitem__(0, 10**30),
    "a node too many": lambda s: s["facets"]["node"].__setitem__(0, len(s["nodes"]["t_s"])),
    "a burn at another time": lambda s: s["burns"][1].update(t_s=8001.0),
    "two nodes": lambda s: s["nodes"].update(
        {k: v and v[:: len(v) - 1] for k, v in s["nodes"].items()}
    ),
    "a node at another time": lambda s: s["nodes"]["t_s"].__setitem__(1, 1.0),
    "no unit of length": lambda s: s["units"].update(length_m=0.0),
    "a large unit of length": lambda s: s["units"].update(length_m=1e308),
    "another unit of time": lambda s: s["units"].update(time_s=1.001 * s["units"]["time_s"]),
    "a violation that is a boolean": lambda s: s["violation"].update(total=True),
    "a negative violation": lambda s: s["violation"].update(max=-1.0),
    "another grid": lambda s: s["scenario"]["grid"].update(step_max_s=2000.0),
    "no window": lambda s: s["scenario"]["observation"].update(incidence_max_deg=1.0),
}


READERS = [verify.main, montecarlo.main, simulate.main]


@pytest.mark.slow
@pytest.mark.parametrize("edit", EDITS)
def test_solution_of_inconsistent_parts_is_refused(solved, edit):
    """By each command that reads one; in usual runs by one of them in turn."""
    content = json.loads((solved / "solution.json").read_text("utf-8"))
    EDITS[edit](content)
    turn = list(EDITS).index(edit) % len(READERS)
    with file_with(json.dumps(content)) as path:
        for main in usually(READERS[turn:] + READERS[:turn], 1):
            assert command(main, [str(path.parent)]) == 2
            reliability.count(reliability.BAD_INPUTS)


@pytest.mark.slow
@pytest.mark.parametrize("word", usually(["[/red]", "\\[", "[bold]", "[/]", "["], 2))
def test_names_of_solution_are_shown_literally(solved, tmp_path, word, monkeypatch):
    """Those of stages; constraints have the names of their scenario, whatever the file carries."""
    fly_few(monkeypatch)
    content = json.loads((solved / "solution.json").read_text("utf-8"))
    content["constraints"][0]["name"] = content["stages"][0]["name"] = word
    with_a_word_as_key(content, word + " too")
    (tmp_path / "solution.json").write_text(json.dumps(content), "utf-8")
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown):
        assert verify.main([str(tmp_path)]) == 4
    assert shown.getvalue().count(word) == 1


def command(main: Callable[[list[str]], int], arguments: list[str]) -> int:
    """A command's exit status, with its output swallowed but for a traceback."""
    errors = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(errors):
        code = status_of(main, *arguments)
    assert "Traceback" not in errors.getvalue()
    if code == 2:
        assert "error: " in errors.getvalue()
    return code


OPTIONS = [
    *("--scenario", "--set", "--init", "--problem", "--method", "--formulation", "--algorithm"),
    *("--solver", "--facet-rounds", "--samples", "--until", "--truth", "--errors", "--seed"),
    *("--workers", "--help", "-h", "--", "-", "--sc", "--s"),
]
VALUES = [
    *("cold", "warm", "P2", "P3", "scp", "ipopt", "lifted", "tuned", "-1", "1e9", "nan", "0.5%"),
    *("risk.p_chance=0.8", "risk=", "=", "a=b=c", "name=[", "/", ".", "/dev/null", "nowhere.json"),
    *("~", "*", "\x00", "\udc80", "é", "a" * 5000, "--set=x", "@file", "%s", "{}", "[bold]"),
]
argument_lists = st.lists(st.sampled_from(OPTIONS + VALUES) | st.text(max_size=8), max_size=6)


def interrupted(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


@patient
@given(argument_lists)
def test_arguments_of_solve_never_trace_or_stray(arguments):
    with tempfile.TemporaryDirectory() as folder, watched() as touched:
        out = Path(folder) / "out"
        with mock.patch.object(planner, "plan", interrupted):
            code = command(solve.main, ["--out", str(out), *arguments, "--method", "scp"])
        written = [path for path in Path(folder).rglob("*") if path.is_file()]
    assert code in (0, 2, 130)  # help, bad input, and the interrupt that stands for the planning
    assert written == []
    for event, given_ in touched:
        if event in ("os.mkdir", "os.remove", "os.rename"):
            assert Path(str(given_[0])).is_relative_to(folder), (event, given_)
    if code == 2:
        reliability.count(reliability.BAD_INPUTS)


@patient
@given(argument_lists, st.sampled_from([verify.main, montecarlo.main]))
def test_arguments_of_other_commands_never_trace(arguments, main):
    code = command(main, arguments)
    assert code in (0, 2)
    if code == 2:
        reliability.count(reliability.BAD_INPUTS)


def test_link_in_folder_is_replaced_not_followed(solved, tmp_path):
    """The user did not name the file that a link named solution.json points to."""
    target = tmp_path / "precious"
    target.write_text("mine", "utf-8")
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "solution.json").symlink_to(target)
    read_solution(solved).write(folder)
    assert target.read_text("utf-8") == "mine"
    assert not (folder / "solution.json").is_symlink()
    reliability.count(reliability.BAD_INPUTS)


@pytest.mark.parametrize("kind", ["scenario", "solution"])
def test_a_link_in_a_circle_is_refused(tmp_path, kind):
    circle = tmp_path / "circle"
    circle.symlink_to(circle)
    reader = {"scenario": load_scenario, "solution": read_solution}[kind]
    with pytest.raises(InputError):
        reader(circle)
    reliability.count(reliability.BAD_INPUTS)
