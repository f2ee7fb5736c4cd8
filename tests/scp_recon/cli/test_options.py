"""Options of commands: those of the functions, each with its help."""

import inspect
import os
from threading import Timer

import pytest

import scp_recon as sr
from scp_recon import files
from scp_recon.__main__ import main
from scp_recon.api.files import keep
from scp_recon.api.inputs import PlanRequest, resolve
from scp_recon.api.options import PlanOptions
from scp_recon.cli.commands import COMMANDS
from scp_recon.cli.options import joined, parameters
from scp_recon.errors import InputError
from scp_recon.files import read_text
from scp_recon.results.read import point_to, read_solution
from tests.scp_recon.support import run_solve

OWN = {"solve": {"file", "out", "report", "verbose"}, "schema": {"file"}}


def test_every_function_has_its_command():
    """But for what commands read and write themselves, and what a report draws. Classes are parts of
    problems by hand.
    """
    verbs = {command.owner for command in COMMANDS.values()} | {sr.scenarios}
    functions = {name for name in sr.__all__ if not inspect.isclass(getattr(sr, name))}
    alone = {name for name in functions if getattr(sr, name) not in verbs}
    assert alone == {"charts", "load", "load_scenario", "read_campaign", "save"}


@pytest.mark.parametrize("name", COMMANDS)
def test_options_are_those_of_the_function(name):
    command = COMMANDS[name]
    known = inspect.signature(command.owner).parameters if command.owner else {}
    options = [one.name for one in parameters(command.function, command.owner)]
    assert len(options) == len({*options})
    assert {*options} - OWN.get(name, {"out", "verbose"}) == {*known} - {"progress", "out"}
    assert all(action.help for action in command.parser()._actions)


STATE = ["--state", "1", "-2", "3", "-4e-1", "5", "-6"]


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ([*STATE, "plan"], ["--state=1 -2 3 -4e-1 5 -6", "plan"]),
        ([*STATE, "7"], ["--state=1 -2 3 -4e-1 5 -6", "7"]),
        ([*STATE[:3], "-h"], ["--state=1 -2", "-h"]),
        (["--state", "-h"], ["--state", "-h"]),
        (["--state", "file.txt", "plan"], ["--state=file.txt", "plan"]),
        (["--state=file.txt", "7"], ["--state=file.txt", "7"]),
        (["--state", "1,2,3", "4,5,6", "plan"], ["--state=1,2,3 4,5,6", "plan"]),
        (["--measured-burn", "2=-1", "-2", "-3", "7"], ["--measured-burn=2=-1 -2 -3", "7"]),
        (["--measured-burn", "2=1,2,3", "plan"], ["--measured-burn=2=1,2,3", "plan"]),
    ],
)
def test_list_option_takes_only_its_numbers(words, expected):
    assert joined(words) == expected


@pytest.mark.slow
def test_algorithm_and_solver_are_recorded(tmp_path):
    run = run_solve(tmp_path, *["--algorithm", "ptr", "--solver", "clarabel", "--problem", "P3"])
    solution = read_solution(tmp_path)
    assert (solution.algorithm, solution.solver) == ("ptr", "CLARABEL")
    assert (run.exit_code, solution.status) == (0, "converged")


EXACT = 'risk.allocation="exact"'


@pytest.mark.parametrize(
    ("problem", "override", "more", "warned"),
    [
        ("P3", "risk.p_chance=0.8", (), True),
        ("P3", "navigation.lead_s=900", (), True),
        ("P3", 'policy.kind="open"', (), True),
        ("P3", "polytopes.cone=12", (), True),
        ("P2", "polytopes.cone=12", (), False),
        ("P2", "polytopes.cone=12", (EXACT,), True),
        ("P3", "burns.dv_max_m_s=0.2", (), False),
        ("P2", "risk.p_chance=0.8", (), False),
        ("P2", 'policy.cost="expected"', (), True),
    ],
)
def test_override_without_effect_is_warned_about(problem, override, more, warned):
    request = PlanRequest(options=PlanOptions(problem), overrides=[override, *more])
    warnings = resolve(request).mission.warnings
    idle = [one.entry for one in warnings if "has no effect" in one.expected]
    assert idle == [override.partition("=")[0]] * warned


@pytest.mark.parametrize(("last", "warned"), [("50842.0", 1), ("34842.0", 0)])
def test_burn_added_after_the_end_is_warned_about(last, warned):
    override = f"burns.times_s=[0.0, 8000.0, 22700.0, 28700.0, {last}]"
    request = PlanRequest(overrides=[override, "schedule.recharge_s=600"])
    found = [str(one) for one in resolve(request).mission.warnings]
    said = "burns.times_s: got a last burn at 50842 s, 16000 s later than before"
    assert sum(one.startswith(said) for one in found) == warned


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("solve recon_b", "solution.json"),
        ("design nightingale", "scenario.toml"),
        ("design nightingale", "design.csv"),
    ],
)
def test_files_of_others_are_refused_before_planning(command, name, tmp_path, capsys):
    (tmp_path / name).write_text("the user's", "utf-8")
    assert main([*command.split(), "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err.startswith("error: --out: got")
    assert [path.read_text("utf-8") for path in tmp_path.iterdir()] == ["the user's"]


WRITERS = (
    "schema {0}/mine.json",
    "windows recon_b --span-days 0.2 --csv {0}/mine.csv",
    "windows recon_b --span-days 0.2 --chart {0}/mine.png",
    "montecarlo {0} --samples 100",
    "montecarlo {0} --samples 100 --miss 2",
    "export {0} --format csv",
    "export {0} --format oem",
    "export {0} --format spk",
    "export {0} --format ck",
    "export {0} --format parquet",
    "report {0}",
    "simulate {0}",
)


@pytest.mark.slow
@pytest.mark.parametrize("line", WRITERS)
def test_every_writer_refuses_what_it_did_not_write(line, tmp_path, solution, capsys):
    """What it wrote itself is written again; the same names with other content are kept."""
    if line.startswith("simulate"):
        pytest.importorskip("Basilisk")
    solution.write(tmp_path)
    words = line.format(tmp_path).split()
    for _ in range(2):
        assert main(words) != 2
    written = [
        path for path in tmp_path.rglob("*") if path.is_file() and path.name != "solution.json"
    ]
    assert written
    for path in written:
        kept = path.read_bytes()
        path.write_text("the user's", "utf-8")
        capsys.readouterr()
        assert main(words) == 2
        assert "holds something else" in capsys.readouterr().err
        assert path.read_text("utf-8") == "the user's"
        path.write_bytes(kept)


def test_own_notes_beside_plans_are_kept(tmp_path, solution, default_plan):
    """Notes under the names of an unverified plan, of old results, and of the latest run."""
    (tmp_path / "solution_unverified.json").write_text("mine", "utf-8")
    with pytest.raises(InputError, match="holds something else"):
        sr.save(default_plan, tmp_path)
    assert (tmp_path / "solution_unverified.json").read_text("utf-8") == "mine"
    folder = tmp_path / "plan"
    folder.mkdir()
    for name in ("old_montecarlo.json", "old_montecarlo_2.json", "montecarlo.json"):
        (folder / name).write_text(name, "utf-8")
    keep(solution, folder)
    kept = {path.name: path.read_text("utf-8") for path in folder.glob("old_*")}
    assert kept == {
        "old_montecarlo.json": "old_montecarlo.json",
        "old_montecarlo_2.json": "old_montecarlo_2.json",
        "old_montecarlo_3.json": "montecarlo.json",
    }
    runs = tmp_path / "runs"
    (runs / "one").mkdir(parents=True)
    (runs / "latest").write_text("my notes", "utf-8")
    point_to(runs / "one", runs)
    assert [path.read_text("utf-8") for path in runs.glob("latest_before/*")] == ["my notes"]
    assert (runs / "latest").resolve() == runs / "one"


with_pipes = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes here")


@with_pipes
@pytest.mark.parametrize("name", ["solution.json", "mine.json", "mine.toml", "mine.csv"])
def test_pipe_without_writer_is_refused_at_once(name, tmp_path, capsys):
    pipe = tmp_path / name
    os.mkfifo(pipe)
    given = tmp_path if name == "solution.json" else pipe
    lines = [["solve", "--scenario", str(pipe)], ["solve", "--init", str(pipe)]]
    lines += [["verify", str(given)], ["report", str(given)]]
    for line in lines:
        assert main(line) == 2
        assert capsys.readouterr().err.count("got ") == 1
    assert main(["solve", "--out", str(tmp_path)]) == 2 or name != "solution.json"


@with_pipes
def test_pipe_is_read_until_its_writer_ends(tmp_path, monkeypatch):
    """A writer that is silent too long is refused, at once or in the middle."""
    monkeypatch.setattr(files, "SILENT_S", 0.1)
    pipe = tmp_path / "mine.toml"
    os.mkfifo(pipe)
    writer = os.open(pipe, os.O_RDWR)
    for begun in (b"", b"name = "):
        os.write(writer, begun)
        with pytest.raises(InputError, match=r"0\.1 s"):
            read_text(pipe, "scenario", "text")
    monkeypatch.undo()
    os.write(writer, b"name = ")
    Timer(0.1, lambda: (os.write(writer, b'"piped"'), os.close(writer))).start()
    assert read_text(pipe, "scenario", "text") == 'name = "piped"'
