"""Whatever the README and the documents show can be run: every command line and every snippet.

A command is run as it is shown, or where it takes long in the quick form that `QUICK` gives for it; one
that has no entry there fails. What sets up, tests or times the project stands in `APART`.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import os
import re
import shlex
import shutil
import subprocess
import sys
import textwrap
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest

from scp_recon.campaigns.study import Study
from scp_recon.cli.commands import export, solve
from scp_recon.mission.mission import Mission
from scp_recon.results.read import read_solution
from scp_recon.scenario.load import load_scenario
from tests.experiments.support import write_kernel
from tests.scp_recon.simulation.short_plan import SHORT, short_plan
from tests.scp_recon.support import fly_few, mission_of

PROJECT = Path(__file__).parents[1]
PAGES = [
    *(PROJECT / name for name in ("README.md", "CONTRIBUTING.md")),
    *sorted((PROJECT / "docs").glob("*.md")),
]

# --- what is shown --------------------------------------------------------------------------------

INLINE = re.compile(r"`((?:\S*python -m|make) [^`]+)`")
COMMAND = re.compile(r"^(?:\S*python -m|make) ")


def blocks(text: str) -> Iterator[str]:
    """What stands in code blocks, indented by four spaces or fenced."""
    fenced = re.compile(r"^```.*?\n(.*?)^```", re.DOTALL | re.MULTILINE)
    yield from fenced.findall(text)
    before = ""
    for indented, lines in groupby(
        fenced.sub("", text).splitlines(), lambda line: line.startswith("    ") or not line.strip()
    ):
        block = "\n".join(lines)
        # Lines indented further below an item of a list are its text.
        if indented and block.strip() and not re.match(r"\s*(?:[-*]|\d+\.) |  ", before):
            yield textwrap.dedent(block).strip("\n")
        before = block.splitlines()[-1] if block.strip() else before


def normal(line: str) -> str:
    """A command line without interpreter's path, comment and needless spaces."""
    words = shlex.split(line, comments=True)
    if words[0].endswith("python"):
        words[0] = "python"
    return shlex.join(words)


def shown() -> dict[str, str]:
    """Every command line to the page that shows it first."""
    found: dict[str, str] = {}
    for page in PAGES:
        text = page.read_text("utf-8")
        lines = [line for block in blocks(text) for line in block.splitlines()]
        lines = [part for line in lines for part in line.split(" && ") if COMMAND.match(part)]
        lines += [" ".join(line.split()) for line in INLINE.findall(text)]
        for line in lines:
            found.setdefault(normal(line), page.name)
    return found


SHOWN = shown()
MODULES = [line for line in SHOWN if line.startswith("python ")]


# --- how it is run --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Quick:
    """How a command line is run here.

    Attributes:
        line: what is run in its place; as shown if empty.
        after: command lines, as shown, whose results it takes up.
        status: exit status that it has to end with.
        needs: a module without which it has to say so and end with 2.
        cut: makes its work less.
    """

    line: str = ""
    after: tuple[str, ...] = ()
    status: int = 0
    needs: str = ""
    cut: Callable[[pytest.MonkeyPatch], None] | None = None


def one_cell(patch: pytest.MonkeyPatch) -> None:
    """The first cell of the quick comparison, whichever is asked for."""
    study = importlib.import_module("experiments.compare_solvers.study")
    cells = study.quick_design()[:1]
    for name in ("quick_design", "full_design"):
        assert callable(getattr(study, name))
        patch.setattr(study, name, lambda: cells)
    exact = study.exact_design(range(1))[:1]
    patch.setattr(study, "exact_design", lambda *_: exact)


def one_trick(patch: pytest.MonkeyPatch) -> None:
    study = importlib.import_module("experiments.nlp_tricks")
    chosen = dict(list(study.tricks().items())[-1:])
    patch.setattr(study, "tricks", lambda: chosen)


def one_case(patch: pytest.MonkeyPatch) -> None:
    study = importlib.import_module("experiments.openscvx_peer")
    patch.setattr(study, "CASES", study.CASES[:1])


def roughly(patch: pytest.MonkeyPatch) -> None:
    planning = importlib.import_module("scp_recon.api.planning")
    patch.setattr(planning, "Search", partial(planning.Search, close=1.0))


def two_kinds(patch: pytest.MonkeyPatch) -> None:
    study = importlib.import_module("experiments.frontier")
    kinds = list(study.KINDS.items())
    patch.setattr(study, "KINDS", dict([kinds[0], kinds[2]]))
    patch.setattr(study, "PROBABILITIES", (0.7,))
    patch.setattr(study, "FLIGHTS", 100)


def the_plan_alone(patch: pytest.MonkeyPatch) -> None:
    study = importlib.import_module("experiments.model_fidelity.study")
    flights = study.flights
    patch.setattr(study, "flights", lambda *arguments: flights(*arguments)[1:])


def short_slews(patch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("Basilisk", reason="needs the extra [sim]")
    flights = importlib.import_module("experiments.timing_rules")
    for name in ("SLEW_S", "RECHARGE_S"):
        assert getattr(flights, name) > 100.0
        patch.setattr(flights, name, 100.0)


def one_figure(patch: pytest.MonkeyPatch) -> None:
    drawing = importlib.import_module("paper_figs.__main__")
    patch.setattr(drawing, "FIGURES", dict(list(drawing.FIGURES.items())[3:4]))


FLOWN: dict[str, object] = {}
"""The flight that every simulation stands for."""


def one_flight(patch: pytest.MonkeyPatch) -> None:
    """Whatever is to be simulated, the short plan is, and only once."""
    pytest.importorskip("Basilisk", reason="needs the extra [sim]")
    simulation = importlib.import_module("scp_recon.simulation.basilisk.simulation")
    simulate = simulation.simulate

    def once(*arguments: object, **options: object) -> object:
        if not FLOWN:
            FLOWN["flight"] = simulate(*arguments, **options)
        return FLOWN["flight"]

    patch.setattr(simulation, "simulate", once)
    patch.setattr(importlib.import_module("experiments.flown_plan"), "SAMPLES", 500)


def simulated(arguments: str, command: str = "scp_recon simulate") -> Quick:
    return Quick(f"python -m {command} {arguments}", needs="Basilisk", cut=one_flight)


TABLE = "python -m experiments observation_table"
COMPARISON = "python -m experiments compare_solvers --quick"
FEW = "--quick --skip-ipopt --samples 100"
CONES = "python -m experiments battery_cones"
DRAW = "python -m paper_figs solver_comparison"

STATE = "-122.618 419.945 -556.206 0.0069457 0.0794873 0.0655264"
IN_FLIGHT = f"python -m scp_recon replan runs/latest --at 17000 --state {STATE} --out runs/again"
EXACT = "python -m scp_recon.solve --set 'risk.allocation=\"exact\"'"

CAMPAIGN = "python -m scp_recon campaign STUDY.toml --out DIR"
NEVER_LIT = """
[[axis]]
entry = "observation.incidence_max_deg"
values = [0.01, 0.02]
"""

NARROW = " ".join(
    f"--set '{entry}'"
    for entry in (
        "design={departure_s = [0, 0], arrival_s = [34842, 34842]}",
        "boundary.home.departure_deg=[158, 158]",
        "boundary.home.arrival_deg=[0, 0]",
        'risk={allocation = "uniform", scope = "node"}',
        'polytopes.ball="tangent"',
        "polytopes.cone=12",
    )
)

QUICK = {
    # planning
    "python -m scp_recon.solve --init warm --facet-rounds 1": Quick(),
    "python -m scp_recon.solve --set risk.p_chance=0.8 --set 'polytopes.ball=\"tangent\"'": Quick(),
    "python -m scp_recon.solve --scenario mine.toml --formulation lifted --out runs/mine": Quick(
        "python -m scp_recon.solve --scenario mine.toml --formulation lifted --out runs/mine "
        "--problem P3"
    ),
    "python -m scp_recon.solve --init runs/mine/solution.json": Quick(),
    "python -m scp_recon.solve --starts 8 --seed 0 --workers 2": Quick(
        "python -m scp_recon.solve --starts 2 --seed 0 --workers 2 --problem P3"
    ),
    "python -m scp_recon.solve --algorithm ptr --solver ECOS": Quick(needs="ecos"),
    "python -m scp_recon.solve --method ipopt": Quick(
        "python -m scp_recon.solve --method ipopt --problem P3"
    ),
    "python -m scp_recon.solve --set 'boundary.frame=\"j2000\"'": Quick(
        "python -m scp_recon.solve --set 'boundary.frame=\"j2000\"' --problem P3"
    ),
    f"{EXACT} --set 'risk.scope=\"flight\"' --set risk.p_chance=0.9": Quick(
        f"{EXACT} --set 'risk.scope=\"flight\"' --set risk.p_chance=0.9 --certify no"
    ),
    f"{EXACT} --objective probability --dv-budget 0.115": Quick(
        f"{EXACT} --objective probability --dv-budget 0.115 --certify no", cut=roughly
    ),
    "python -m scp_recon.solve --out DIR": Quick(
        "python -m scp_recon.solve --out runs/dir --problem P3"
    ),
    # where it may go
    "python -m scp_recon new mission --body Bennu --site 20,150 --epoch 2020-01-21T20:33:17": Quick(),
    "python -m scp_recon new flown --from-spice all.tm --spacecraft=-64 --body Bennu --site 55.9,41.8 "
    "--from 2020-01-21T20:32:08 --to 2020-01-22T06:12:49": Quick(
        "python -m scp_recon new flown --from-spice all.tm --spacecraft=-999 --body Bennu "
        "--site 55.9,41.8 --from 2020-01-21T20:32:08 --to 2020-01-22T06:12:49",
        needs="spiceypy",
    ),
    "python -m scp_recon.solve --scenario flown.toml --init flown_start.csv": Quick(
        "python -m scp_recon.solve --scenario mine.toml --init start.csv --problem P3"
    ),
    "python -m scp_recon windows recon_b": Quick(),
    "python -m scp_recon design nightingale": Quick(
        f"python -m scp_recon design nightingale {NARROW}", needs="matplotlib"
    ),
    "python -m scp_recon.solve --scenario runs/latest/scenario.toml": Quick(
        "python -m scp_recon.solve --scenario recon_b --problem P3"
    ),
    "python -m scp_recon windows recon_b --from 2020-02-01 --span-days 3 --csv windows.csv "
    "--chart windows.png": Quick(needs="matplotlib"),
    # its result
    "python -m scp_recon verify runs/mine": Quick(),
    "python -m scp_recon compare runs/latest runs/mine": Quick(),
    "python -m scp_recon report runs/latest runs/mine": Quick(needs="plotly"),
    "python -m scp_recon montecarlo": Quick(
        "python -m scp_recon montecarlo runs/mine --samples 500"
    ),
    "python -m scp_recon montecarlo runs/mine --until 0.5% --samples 100000": Quick(
        "python -m scp_recon montecarlo runs/mine --until 5% --samples 2000"
    ),
    "python -m scp_recon montecarlo runs/latest": Quick(
        "python -m scp_recon montecarlo runs/latest --samples 500"
    ),
    "python -m paper_figs flyby --runs runs/mine --out flyby.svg": Quick(needs="matplotlib"),
    "python -m paper_figs frames --out docs/frames.png": Quick(
        "python -m paper_figs frames --out frames.png", needs="matplotlib"
    ),
    "python -m scp_recon schema docs/scenario.schema.json": Quick(),
    # many of them
    CAMPAIGN: Quick("python -m scp_recon campaign study.toml --out runs/campaign --workers 0"),
    f"{CAMPAIGN} --workers 2": Quick(
        "python -m scp_recon campaign study.toml --out runs/campaign --workers 1"
    ),
    **{
        f"python -m scp_recon campaign examples/studies/{name}.toml --out runs/{name}": Quick(
            f"python -m scp_recon campaign study.toml --out runs/{name} --workers 0"
        )
        for name in ("reconnaissance_map", "errors", "asteroid_year", "sizes")
    },
    "python -m scp_recon report runs/reconnaissance_map": Quick(
        "python -m scp_recon report runs/campaign", after=(CAMPAIGN,), needs="plotly"
    ),
    # in flight
    IN_FLIGHT: Quick(),
    "python -m scp_recon replan runs/mine --at 17000 --state state.txt": Quick(
        f"python -m scp_recon replan runs/mine --at 17000 --state {STATE}"
    ),
    "python -m scp_recon export runs/mine --format oem": Quick(),
    "python -m scp_recon.solve --init runs/mine/export/FILE.csv": Quick(
        "python -m scp_recon.solve --init start.csv --problem P3"
    ),
    # the spacecraft
    "python -m scp_recon simulate runs/mine": simulated("runs/short"),
    "python -m scp_recon simulate runs/latest": simulated("runs/short --seed 1"),
    "python -m scp_recon simulate SOLUTION": simulated("runs/short/solution.json"),
    "python -m scp_recon simulate SOLUTION --out DIR": simulated("runs/short --out runs/flight"),
    # the studies
    TABLE: Quick(f"{TABLE} {FEW}"),
    f"{TABLE} --as-flown FILE": Quick(f"{TABLE} --as-flown flight.bsp {FEW}", needs="spiceypy"),
    COMPARISON: Quick(cut=one_cell),
    "python -m experiments compare_solvers --full": Quick(cut=one_cell),
    "python -m experiments compare_solvers --exact": Quick(cut=one_cell),
    "python -m experiments nlp_tricks": Quick(cut=one_trick),
    "python -m experiments frontier": Quick(cut=two_kinds),
    "python -m experiments openscvx_peer": Quick(cut=one_case, needs="openscvx"),
    "python -m experiments flown_plan runs/latest": simulated(
        "runs/short --seeds 1 --out runs/flown_plan", "experiments flown_plan"
    ),
    "python -m experiments timing_rules": Quick(
        "python -m experiments timing_rules --slews 3", needs="Basilisk", cut=short_slews
    ),
    "python -m experiments model_fidelity": Quick(
        "python -m experiments model_fidelity --solution runs/short", cut=the_plan_alone
    ),
    CONES: Quick(f"{CONES} --samples 500"),
    "python -m experiments NAME": Quick(f"{CONES} --samples 100 --seed 1"),
    "python -m experiments uncertainty_sources --flights 4": Quick(
        "python -m experiments uncertainty_sources --flights 0 --paths 100 --solution runs/short"
    ),
    # the figures
    "python -m paper_figs": Quick(after=(TABLE, CONES), cut=one_figure, needs="matplotlib"),
    "python -m paper_figs --runs runs/mine": Quick(cut=one_figure, needs="matplotlib"),
    "python -m paper_figs --all": Quick(
        "python -m paper_figs", after=(TABLE, CONES), cut=one_figure, needs="matplotlib"
    ),
    "python -m paper_figs NAME --out FILE": Quick(
        "python -m paper_figs battery_cones --out cones.svg",
        after=(CONES,),
        needs="matplotlib",
    ),
    f"{DRAW} --out runs/comparison": Quick(
        f"{DRAW} --runs runs/comparison_quick --out runs/comparison_quick",
        after=(COMPARISON,),
        needs="matplotlib",
    ),
}

APART = {
    "python -m pip install --constraint constraints.txt --editable '.[compare]'",
    "python -m benchmarks --readme",  # takes minutes, and writes the README
    "python -m benchmarks.campaign_scale",
}
"""What sets up or times the project: only its modules and options are looked for."""


class Workspace:
    """A folder in which commands are run, each once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.done: set[str] = set()

    def run(self, line: str) -> None:
        """Run a command line that is shown, after those that it builds upon."""
        quick = QUICK[line]
        for other in quick.after:
            if other not in self.done:
                self.run(other)
        command = quick.line or line
        lacking = bool(quick.needs) and importlib.util.find_spec(quick.needs) is None
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(self.folder)
            if quick.cut:
                quick.cut(patch)
            status = call(shlex.split(command)[2:])
        assert status == (2 if lacking else quick.status), command
        self.done.add(line)


def call(words: Sequence[str]) -> int:
    """Exit status of `python -m` with these words, in this process where the module has a `main`."""
    module, *arguments = words
    spec = importlib.util.find_spec(module)
    assert spec is not None, f"there is no module {module}"
    within = module if spec.submodule_search_locations is None else f"{module}.__main__"
    main = getattr(importlib.import_module(within), "main", None)
    if main is None:
        command = [sys.executable, "-m", *words]
        places = {"PYTHONPATH": str(PROJECT), "COLUMNS": "200"}
        run = subprocess.run(
            command,
            env=os.environ | places,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        print(run.stdout, run.stderr)
        return run.returncode
    try:
        return int(main(arguments))
    except SystemExit as end:  # argparse ends this way
        return int(end.code or 0)


@pytest.fixture(scope="module", autouse=True)
def few_flights() -> Iterator[None]:
    """Of what is verified: that it runs does not depend on their number."""
    with pytest.MonkeyPatch.context() as patch:
        fly_few(patch)
        yield


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """With the folders and files that the lines speak of."""
    folder = tmp_path_factory.mktemp("workspace")
    (toml,) = snippets_of("README.md")["toml"]
    (folder / "mine.toml").write_text(toml, encoding="utf-8")
    (folder / "study.toml").write_text(NEVER_LIT, encoding="utf-8")
    assert solve.main(["--init", "cold", "--out", str(folder / "runs" / "latest")]) == 0
    shutil.copytree(folder / "runs" / "latest", folder / "runs" / "mine")
    short = folder / "runs" / "short"
    short.mkdir()
    short_plan(mission_of(*SHORT)).write(short)
    if importlib.util.find_spec("spiceypy"):
        plan = read_solution(folder / "runs" / "latest")
        mission = Mission.from_scenario(plan.scenario)
        write_kernel(folder / "flight.bsp", mission, np.array(plan.nodes.state))
        for form in ("spk", "ck"):
            assert export.main([str(folder / "runs" / "mine"), "--format", form]) == 0
        (listed,) = (folder / "runs" / "mine" / "export").glob("*.tm")
        shutil.copy(listed, folder / "all.tm")
    assert export.main([str(folder / "runs" / "mine"), "--format", "csv"]) == 0
    (table,) = (folder / "runs" / "mine" / "export").glob("*.csv")
    shutil.copy(table, folder / "start.csv")
    return Workspace(folder)


@pytest.mark.parametrize("line", [line for line in MODULES if line not in APART])
def test_a_command_that_is_shown_runs(line: str, workspace: Workspace) -> None:
    assert line in QUICK, f"{SHOWN[line]} shows it, and QUICK does not say how to run it here"
    if line not in workspace.done:
        workspace.run(line)


@pytest.mark.parametrize("line", MODULES)
def test_modules_and_options_that_are_shown_exist(
    line: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of what is run in a quick form or not at all, too."""
    module, *arguments = shlex.split(line)[2:]
    if module == "pip":
        assert (PROJECT / arguments[arguments.index("--constraint") + 1]).exists()
        extras = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))["project"]
        assert set(re.findall(r"\[(\w+)\]", line)) <= set(extras["optional-dependencies"])
        return
    options = [word for word in arguments if word.startswith("--")]
    if not options:  # what is run is this very module, or one of those that it stands for
        run = QUICK.get(line, Quick()).line or line
        assert re.sub(r"\b(NAME|X)$", "battery_cones", module) in run
        return
    monkeypatch.setenv("COLUMNS", "200")
    named = [module, *arguments[:1]] if module in ("scp_recon", "experiments") else [module]
    assert call([*named, "--help"]) == 0
    said = capsys.readouterr().out
    for option in options:
        assert re.search(rf"{option}\b", said), f"{module} has no option {option}"


def test_no_entry_is_left_of_a_line_that_is_shown_no_more() -> None:
    assert {line for line in QUICK if line not in SHOWN} == set()
    assert {line for line in APART if line not in SHOWN} == set()


def test_targets_that_are_shown_exist_and_do_what_is_said() -> None:
    makefile = (PROJECT / "Makefile").read_text("utf-8")
    recipes = dict(re.findall(r"^(\w+):.*\n((?:\t.*\n)*)", makefile, re.MULTILINE))
    for line in (line for line in SHOWN if line.startswith("make ")):
        for target in line.split()[1:]:
            assert target in recipes, f"{SHOWN[line]} shows {line}"
    readme = (PROJECT / "README.md").read_text("utf-8")
    for target, words in re.findall(r"make (\w+) +# set up, then: (?:python -m )?(.+)", readme):
        assert f"python -m {words}" in recipes[target]


# --- snippets -------------------------------------------------------------------------------------


def snippets_of(page: str) -> dict[str, list[str]]:
    """TOML and Python of a page; what is neither shows what commands print, or is a mere comment."""
    found: dict[str, list[str]] = {"toml": [], "python": []}
    for block in blocks((PROJECT / page).read_text("utf-8")):
        if any(COMMAND.match(line) for line in block.splitlines()):
            continue
        for language, reader in (("toml", tomllib.loads), ("python", ast.parse)):
            try:
                content = reader(block)
            except (tomllib.TOMLDecodeError, SyntaxError):
                continue
            if content:
                found[language].append(block)
            break
    return found


def test_scenarios_that_are_shown_are_read(tmp_path: Path) -> None:
    scenarios = [
        block for page in PAGES for block in snippets_of(page.relative_to(PROJECT))["toml"]
    ]
    assert scenarios
    for block in scenarios:
        if "campaign" in (tables := tomllib.loads(block)):
            assert len(Study.validated(tables).cases) > 1
            continue
        (tmp_path / "mine.toml").write_text(block, encoding="utf-8")
        assert load_scenario(tmp_path / "mine.toml") != load_scenario()


SHOWING_PYTHON = {
    page: found
    for page in (str(path.relative_to(PROJECT)) for path in PAGES)
    if (found := snippets_of(page)["python"])
}


@pytest.mark.parametrize("page", SHOWING_PYTHON)
def test_python_that_is_shown_runs(
    page: str, workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One snippet of a page after the other, as in one session, with fewer flights."""
    monkeypatch.chdir(workspace.folder)
    names: dict[str, object] = {}
    for block in SHOWING_PYTHON[page]:
        few = re.sub(r"samples=[\d_]+", "samples=500", block)
        exec(compile(few, page, "exec"), names)


def test_the_readme_shows_python() -> None:
    assert "README.md" in SHOWING_PYTHON
