"""Everything that README and documents show can be run: every command line and every snippet.

A command is run as it is shown, or where it takes long with less work, as `QUICK` says; one that has no
entry there fails. What sets up, times, or takes hours stands in `APART`. It is read against the command
line's help, as is what prose says of a command and what `make` runs.
"""

import ast
import importlib
import importlib.util
import pkgutil
import re
import shlex
import shutil
import textwrap
import tomllib
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings

from experiments import evidence
from experiments.__main__ import module_of
from experiments.evidence import SOURCES
from scp_recon.campaigns.study import Study
from scp_recon.cli.commands import export, solve
from scp_recon.mission.mission import Mission
from scp_recon.results.read import read_solution
from scp_recon.scenario.load import base_names, load_scenario
from tests.experiments.support import write_kernel
from tests.helpers import MANY
from tests.scp_recon.simulation.short_plan import SHORT, short_plan
from tests.scp_recon.support import fly_few, mission_of

pytestmark = pytest.mark.slow

PROJECT = Path(__file__).parents[1]
MAKEFILE = (PROJECT / "Makefile").read_text("utf-8")
PYPROJECT = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))["project"]
EXTRAS = PYPROJECT["optional-dependencies"]
PAGES = [
    *(PROJECT / name for name in ("README.md", "CONTRIBUTING.md")),
    *sorted(p for p in (PROJECT / "docs").rglob("*.md") if p.parent.name != "reference"),
]
INLINE = re.compile(r"`((?:\S*python -m|make) [^`]+)`")
COMMAND = re.compile(r"^(?:\S*python -m|make|scp-recon) ")
MENTIONED = re.compile(r"`(scp-recon|pytest) ([^`]+)`")
RECIPE = re.compile(
    r"\$\(BIN\)/(python -m (?!pytest|scp_recon.reference).+?)(?= && | \|\| |$)", re.MULTILINE
)


@cache
def blocks(page: Path) -> tuple[str, ...]:
    """The code blocks of a page, fenced or indented by four spaces."""
    fenced = re.compile(r"^```.*?\n(.*?)^```", re.DOTALL | re.MULTILINE)
    text, before = page.read_text("utf-8"), ""
    found = fenced.findall(text)
    for indented, lines in groupby(
        fenced.sub("", text).splitlines(), lambda line: line.startswith("    ") or not line.strip()
    ):
        block = "\n".join(lines)
        # Lines indented further below an item of a list are its text.
        if indented and block.strip() and not re.match(r"\s*(?:[-*]|\d+\.) |  ", before):
            found.append(textwrap.dedent(block).strip("\n"))
        before = block.splitlines()[-1] if block.strip() else before
    return tuple(found)


def shown() -> dict[str, str]:
    """Every command line, without interpreter's path and comment, to the page that shows it first."""
    found: dict[str, str] = {}
    for page in PAGES:
        lines = [line for block in blocks(page) for line in block.splitlines()]
        lines = [part for line in lines for part in line.split(" && ") if COMMAND.match(part)]
        lines += [" ".join(line.split()) for line in INLINE.findall(page.read_text("utf-8"))]
        for words in (shlex.split(line, comments=True) for line in lines):
            if words[0].endswith("python"):
                words[0] = "python"
            elif words[0] == "scp-recon":
                words[:1] = ["python", "-m", "scp_recon"]
            found.setdefault(shlex.join(words), page.name)
    return found


def mentioned() -> list[str]:
    """Command lines in prose without an interpreter, and those of the Makefile."""
    pages = (*PAGES, PROJECT / "CHANGELOG.md", *(PROJECT / "docs").glob("reference/*.md"))
    said = {found for page in pages for found in MENTIONED.findall(page.read_text("utf-8"))}
    lines = [f"python -m {name.replace('-', '_')} {rest}" for name, rest in sorted(said)]
    return lines + RECIPE.findall(MAKEFILE)


SHOWN = shown()
MODULES = [line for line in SHOWN if line.startswith("python ")]


@dataclass(frozen=True)
class Quick:
    """How a command line is run here.

    Attributes:
        more: options in addition, of which the last one of a name counts.
        line: run in its place, if given.
        after: command lines, as shown, whose results it takes up.
        needs: a module without which it has to say so and end with 2.
        less: attributes of modules, and what stands for each meanwhile, so that there is less work.
        nightly: whether usual runs leave it out: other tests do the same work every day.
    """

    more: str = ""
    line: str = ""
    after: tuple[str, ...] = ()
    needs: str = ""
    less: tuple[tuple[str, Callable[[Any], Any]], ...] = ()
    nightly: bool = False


FLOWN: list[object] = []
"""The flight that every simulation stands for."""


def once(simulate: Callable[..., object]) -> Callable[..., object]:
    """Simulates the first flight that is asked for, and gives it for every other."""

    def simulated(*arguments: object, **options: object) -> object:
        FLOWN.extend([] if FLOWN else [simulate(*arguments, **options)])
        return FLOWN[0]

    return simulated


ONE_FLIGHT = (
    ("scp_recon.simulation.basilisk.simulation.simulate", once),
    ("experiments.spacecraft.flown_plan.SAMPLES", lambda _: 500),
)
ONE_FIGURE = (("paper_figs.__main__.FIGURES", lambda every: dict([*every.items()][3:4])),)
TWO_KINDS = (
    ("experiments.frontier.KINDS", lambda kinds: dict([*kinds.items()][:3:2])),
    ("experiments.frontier.PROBABILITIES", lambda _: (0.7,)),
    ("experiments.frontier.FLIGHTS", lambda _: 100),
)
NOT_SERVING = (("scp_recon.api.exploring.Server.serve_forever", lambda _: lambda *_: None),)
DESIGNS = "experiments.solvers.compare_solvers"
ONE_CELL = (
    (f"{DESIGNS}.full_design", lambda cells: lambda: cells()[:1]),
    (f"{DESIGNS}.exact_design", lambda cells: lambda: cells(range(1))[:1]),
)
LAST_TRICK = (
    ("experiments.solvers.nlp_tricks.tricks", lambda it: lambda: dict([*it().items()][-1:])),
)
SHORT_TIMES = tuple(
    (f"experiments.spacecraft.timing_rules.{name}", lambda _: 100.0)
    for name in ("SLEW_S", "RECHARGE_S")
)
NO_FIRST_FLIGHT = (
    ("experiments.model_fidelity.flights", lambda fly: lambda *a: {"plan": fly(*a)["plan"]}),
)


def first_of(module: str, *names: str) -> tuple[tuple[str, Callable[[Any], Any]], ...]:
    """The first alone of all cases in lists of a module of the studies."""
    return tuple((f"experiments.{module}.{name}", lambda cases: cases[:1]) for name in names)


TABLE = "python -m experiments observation_table"
COMPARISON = "python -m experiments compare_solvers --full"
CONES = "python -m experiments battery_cones"
FEW = "--quick --skip-ipopt --samples 100"
SOLVE = "python -m scp_recon.solve"
RUN = "python -m scp_recon"
MEASURED = (
    f"{SOLVE} --set navigation.sigma_position_m=10 --set navigation.sigma_velocity_m_s=0.0005 "
    "--out runs/measured"
)
EXACT = f"{SOLVE} --set 'risk.allocation=\"exact\"'"
CAMPAIGN = f"{RUN} campaign STUDY.toml --out DIR"
EV5 = (
    f"{RUN} new ev5 --body '2008 EV5' --site=-20,240 --epoch 2017-09-04T00:00:00 --gm 2.91 "
    "--radius 200 --period 3.725 --pole=90,-66.56 "
    "--orbit=-152107575,-147026,21468081,-0.2953,-26.0849,-11.0290"
)
OWN = (
    f"{SOLVE} --scenario ev5.toml --set 'body.radii_m=[210, 205, 195]' --set body.j2=0.025 "
    "--set 'risk.allocation=\"exact\"' --set 'risk.scope=\"flight\"' --set risk.p_chance=0.9 "
    "--out runs/ev5"
)
STATE = "-122.618 419.945 -556.206 0.0069457 0.0794873 0.0655264"
NEVER_LIT = '[[axis]]\nentry = "observation.incidence_max_deg"\nvalues = [0.01, 0.02]\n'
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
SIMULATED = Quick(needs="Basilisk", less=ONE_FLIGHT, nightly=True)
PLAIN, P3, IN_P3 = Quick(), Quick("--problem P3"), "--out runs/dir --problem P3"
LATER = Quick(nightly=True)  # just as it is shown
FROM_TABLE = Quick(line=f"{SOLVE} --scenario mine.toml --init start.csv --problem P3")

QUICK = {
    # planning
    f"{SOLVE} --init warm --facet-rounds 1": PLAIN,
    f"{SOLVE} --scenario mine.toml --set risk.p_chance=0.8 --out runs/mine": PLAIN,
    f"{SOLVE} --starts 8 --seed 0 --workers 2": LATER,
    f"{SOLVE} --method ipopt": LATER,
    f"{SOLVE} --formulation lifted": LATER,
    f"{SOLVE} --set 'boundary.frame=\"j2000\"'": P3,
    f"{SOLVE} --out DIR": Quick(IN_P3),
    f"{EXACT} --set 'risk.scope=\"flight\"' --set risk.p_chance=0.9": LATER,
    f"{SOLVE} --set 'policy.kind=\"feedback\"' --set navigation.lead_s=0 "
    "--set navigation.sigma_position_m=10 --set navigation.sigma_velocity_m_s=0.0005": PLAIN,
    MEASURED: PLAIN,
    f"{EXACT} --objective probability --dv-budget 0.115": Quick(
        "--certify no", less=(("scp_recon.api.planning.Search", lambda s: partial(s, close=1.0)),)
    ),
    f"{RUN} explore recon_b": Quick("--no-browser", needs="plotly", less=NOT_SERVING),
    # where it may go
    f"{RUN} new mission --body Bennu --site 20,150 --epoch 2020-01-21T20:33:17": PLAIN,
    f"{RUN} new flown --from-spice all.tm --spacecraft=-64 --body Bennu --site 55.9,41.8 "
    "--from 2020-01-21T20:32:08 --to 2020-01-22T06:12:49": Quick(
        "--spacecraft=-999", needs="spiceypy"
    ),
    f"{SOLVE} --scenario flown.toml --init flown_start.csv": FROM_TABLE,
    EV5: PLAIN,
    OWN: Quick(after=(EV5,)),
    f"{RUN} windows recon_b": PLAIN,
    f"{RUN} windows recon_b --from 2020-02-01 --span-days 3 --csv windows.csv "
    "--chart windows.png": Quick(needs="matplotlib"),
    f"{RUN} design nightingale": Quick(NARROW, needs="matplotlib", nightly=True),
    f"{SOLVE} --scenario runs/latest/scenario.toml": Quick(line=f"{SOLVE} --out DIR {IN_P3}"),
    # its result
    f"{RUN} verify runs/mine": PLAIN,
    f"{RUN} compare runs/latest runs/mine": PLAIN,
    f"{RUN} report runs/latest runs/mine": Quick(needs="plotly"),
    f"{RUN} montecarlo runs/mine --until 0.5% --samples 100000": Quick("--until 5% --samples 2000"),
    f"{RUN} montecarlo runs/measured --policy replan --samples 2000 --workers 2": Quick(
        "--samples 20 --workers 1", after=(MEASURED,)
    ),
    f"{RUN} montecarlo runs/latest": Quick("--samples 500"),
    f"{RUN} export runs/mine --format oem": PLAIN,
    f"{SOLVE} --init runs/mine/export/FILE.csv": FROM_TABLE,
    f"{RUN} schema docs/scenario.schema.json": PLAIN,
    # in flight
    f"{SOLVE} --out runs/default": Quick(IN_P3),
    f"{RUN} replan runs/default --at 17000 --state {STATE} --out runs/again": PLAIN,
    f"{RUN} replan runs/mine --at 17000 --state -150 470 -560 0.005 0.079 0.069": PLAIN,
    # many of them
    CAMPAIGN: Quick("--workers 0"),
    f"{CAMPAIGN} --workers 2": Quick("--workers 1 --out runs/in_a_process", nightly=True),
    f"{RUN} report runs/reconnaissance_map": Quick(
        line=f"{RUN} report DIR", after=(CAMPAIGN,), needs="plotly"
    ),
    # the spacecraft
    f"{RUN} simulate runs/mine": replace(SIMULATED, line=f"{RUN} simulate runs/short"),
    f"{RUN} simulate SOLUTION": replace(SIMULATED, more="--seed 1"),
    f"{RUN} simulate SOLUTION --out DIR": replace(SIMULATED, more="--out runs/flight"),
    # the studies
    TABLE: Quick(FEW),
    f"{TABLE} --as-flown FILE": Quick(f"--as-flown flight.bsp {FEW}", needs="spiceypy"),
    COMPARISON: Quick(less=ONE_CELL, nightly=True),
    "python -m experiments compare_solvers --exact": Quick(less=ONE_CELL, nightly=True),
    "python -m experiments nlp_tricks": Quick(nightly=True, less=LAST_TRICK),
    "python -m experiments evidence --check": LATER,
    "python -m experiments frontier": Quick(less=TWO_KINDS),
    "python -m experiments gallery": Quick(
        less=(("experiments.gallery.BODIES", lambda bodies: {"apophis": bodies["apophis"]}),),
        nightly=True,
    ),
    "python -m experiments feedback": Quick(
        "--quick",
        less=(
            *first_of("in_flight.feedback", "QUICK"),
            ("experiments.in_flight.feedback.ERRORS_AT", lambda at: at[-1:]),
        ),
        nightly=True,
    ),
    "python -m experiments policies": Quick(
        "--flights 20", nightly=True, less=first_of("in_flight.policies", "CASES")
    ),
    "python -m experiments lifted": Quick(less=first_of("solvers.lifted", "FORMS")),
    "python -m experiments accuracy": Quick(
        less=(
            *first_of("solvers.accuracy", "METHODS"),
            (
                "experiments.solvers.accuracy.PROBLEMS",
                lambda problems: {"replan": problems["replan"]},
            ),
        ),
        nightly=True,
    ),
    "python -m experiments sensitivity": Quick(
        less=(
            *first_of("solvers.sensitivity", "VARIED"),
            ("experiments.solvers.sensitivity.MULTIPLES", lambda multiples: multiples[3:4]),
        ),
        nightly=True,
    ),
    "python -m experiments peers": Quick(
        needs="scocp",
        nightly=True,
        less=first_of("solvers.peers.study", "OURS", "WEIGHTS", "P3_CASES", "GUESSED"),
    ),
    "python -m experiments spice": Quick(needs="spiceypy"),
    "python -m experiments cross_check": Quick(needs="orekit_jpype"),
    "python -m experiments flown_plan": replace(
        SIMULATED,
        line="python -m experiments flown_plan runs/short --seeds 1 --out runs/flown_plan",
    ),
    "python -m experiments flown_policies default": replace(SIMULATED, more="--seeds 1"),
    "python -m experiments timing_rules": replace(SIMULATED, more="--slews 3", less=SHORT_TIMES),
    "python -m experiments model_fidelity": Quick(
        "--solution runs/short", nightly=True, less=NO_FIRST_FLIGHT
    ),
    CONES: Quick("--samples 500"),
    "python -m experiments uncertainty_sources --flights 4": Quick(
        "--flights 0 --paths 100 --solution runs/short"
    ),
    # the figures
    "python -m paper_figs": Quick(
        after=(TABLE, CONES), less=ONE_FIGURE, needs="matplotlib", nightly=True
    ),
    "python -m paper_figs NAME --out FILE": Quick(
        line="python -m paper_figs battery_cones --out cones.svg",
        after=(CONES,),
        needs="matplotlib",
    ),
    "python -m paper_figs flyby --runs runs/mine --out flyby.svg": Quick(needs="matplotlib"),
    "python -m paper_figs solver_comparison --out runs/comparison": Quick(
        "--runs runs/comparison", after=(COMPARISON,), needs="matplotlib", nightly=True
    ),
}

STUDIES = ("reconnaissance_map", "ryugu_map", "errors", "asteroid_year", "sizes", "navigation")
APART = {
    "python -m pip install --constraint constraints.txt --editable '.[compare]'",
    "python -m pip install --constraint constraints.txt --editable '.[crosscheck]'",
    "python -m benchmarks",  # takes minutes
    "python -m benchmarks growth",
    "python -m benchmarks campaign_scale",
    "python -m benchmarks waits",
    "python -m experiments maps",  # runs campaigns
    "python -m experiments maps --sample",
    f"{RUN} design ryugu",
    f"{RUN} montecarlo runs/latest --truth polyhedron",
    "python -m experiments sites",  # designs passes, which takes minutes
    "python -m experiments plans --designs",
    "python -m experiments testing reliability",  # runs tests
    *(f"{RUN} campaign examples/studies/{name}.toml --out runs/{name}" for name in STUDIES),
}
"""Only modules, options and files of these are looked for."""


class Workspace:
    """A folder in which commands are run, each once as it is run here."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.done: set[str] = set()

    def run(self, line: str) -> None:
        """Run a command line that is shown, after those that it builds upon."""
        quick = QUICK[line]
        for other in quick.after:
            self.run(other)
        command = f"{quick.line or line} {quick.more}".strip()
        if command in self.done:
            return
        lacking = bool(quick.needs) and importlib.util.find_spec(quick.needs) is None
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(self.folder)
            for path, stand_in in () if lacking else quick.less:
                place, _, name = path.rpartition(".")
                owner = pkgutil.resolve_name(place)
                patch.setattr(owner, name, stand_in(getattr(owner, name)))
            status = call(shlex.split(command)[2:])
        assert status == (2 if lacking else 0), line
        self.done.add(command)


def call(words: Sequence[str]) -> int:
    """Exit status of `python -m` with these words, in this process."""
    module, *arguments = words
    if module == "scp_recon.solve":  # which has no `main`, and is run as a program elsewhere
        module, arguments = "scp_recon", ["solve", *arguments]
    spec = importlib.util.find_spec(module)
    assert spec is not None, f"there is no module {module}"
    within = module if spec.submodule_search_locations is None else f"{module}.__main__"
    try:
        return int(importlib.import_module(within).main(arguments))
    except SystemExit as end:  # argparse ends this way
        return int(end.code or 0)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory) -> Iterator[Workspace]:
    """With the folders and files that the lines speak of; verification flies few flights."""
    folder = tmp_path_factory.mktemp("workspace")
    (folder / "mine.toml").write_text(snippets_of(PROJECT / "README.md")["toml"][0], "utf-8")
    for name in ("STUDY.toml", "study.toml"):
        (folder / name).write_text(NEVER_LIT, "utf-8")
    (folder / "docs").mkdir()
    runs = folder / "runs"
    with pytest.MonkeyPatch.context() as patch:
        fly_few(patch)
        assert solve.main(["--init", "cold", "--out", str(runs / "latest")]) == 0
        for name in ("mine", "default"):
            shutil.copytree(runs / "latest", runs / name)
        (runs / "short").mkdir()
        short_plan(mission_of(*SHORT)).write(runs / "short")
        shutil.copytree(runs / "short", folder / "SOLUTION")
        forms = ("csv",)
        if importlib.util.find_spec("spiceypy"):
            forms = ("csv", "spk", "ck")
            plan = read_solution(runs / "latest")
            mission = Mission.from_scenario(plan.scenario)
            write_kernel(folder / "flight.bsp", mission, np.array(plan.nodes.state))
        for form in forms:
            assert export.main([str(runs / "mine"), "--format", form]) == 0
        shutil.copytree(runs / "mine", folder / "exported")
        names = {".csv": "start.csv", ".tm": "all.tm"}
        for path in (runs / "mine" / "export").iterdir():
            shutil.copy(path, folder / names.get(path.suffix, path.name))
        yield Workspace(folder)


HARD = settings().max_examples >= MANY


def is_due(line: str) -> bool:
    """Whether this run is one that runs a line."""
    return line not in APART and (HARD or not QUICK.get(line, PLAIN).nightly)


@pytest.mark.parametrize("line", [line for line in MODULES if is_due(line)])
def test_a_command_that_is_shown_runs(line, workspace):
    assert line in QUICK, f"{SHOWN[line]} shows it, and QUICK does not say how to run it here"
    workspace.run(line)


@pytest.mark.parametrize(
    "name",
    [n for n, s in SOURCES.items() if (line := f"python -m {s.command}") in QUICK and is_due(line)],
)
def test_a_study_writes_the_columns_that_the_pages_show(name, workspace):
    """Of evidence that is renewed nothing is missing."""
    line = f"python -m {SOURCES[name].command}"
    workspace.run(line)
    folder = (QUICK[line].line + QUICK[line].more).partition("--out ")[2].split(" ")[0]
    study = importlib.import_module(module_of(line.split()[3])).STUDY
    out = workspace.folder / (folder or Path("runs") / (study.folder or name)) / evidence.FILE
    if QUICK[line].needs and not out.exists():
        pytest.skip("needs an extra")
    found = evidence.Evidence.read(out).tables
    for table, rows in evidence.Evidence.read(evidence.path_of(name)).tables.items():
        written = {column for row in found.get(table, ()) for column in row}
        # With less work a table may be empty, or lack the columns of the other probabilities.
        missing = {column for column in rows[0] if not column.startswith("0_")} - written
        assert not written or not missing, table


def test_no_entry_is_left_of_a_line_that_is_shown_no_more():
    assert {*QUICK, *APART} - SHOWN.keys() == set()


def test_modules_options_and_files_that_are_shown_exist(capsys, monkeypatch, pytestconfig):
    """Also of what is run with other ones, or not at all."""
    monkeypatch.setenv("COLUMNS", "200")
    helps: dict[tuple[str, ...], str] = {}
    for line in (*MODULES, *mentioned()):
        module, *arguments = shlex.split(line)[2:]
        for name in (word for word in arguments if word.startswith("examples/")):
            tables = tomllib.loads((PROJECT / name).read_text("utf-8"))
            for axis in tables["axis"]:  # a few days have a window of each kind as well
                axis.get("windows", {}).update(span_days=3, every=1)
            assert len(Study.validated(tables).cases) > 1
        if module == "pip":
            assert (PROJECT / arguments[arguments.index("--constraint") + 1]).exists()
            assert {*re.findall(r"\[(\w+)\]", line)} <= EXTRAS.keys()
            continue
        options = [word.partition("=")[0] for word in arguments if word.startswith("--")]
        if module == "pytest":
            assert all(pytestconfig.getoption(option) is not None for option in options)
            continue
        of = arguments[:1] if module in ("scp_recon", "experiments") else []
        if (key := (module, *of)) not in helps and of != ["NAME"]:
            assert call([*key, "--help"]) == 0
            helps[key] = capsys.readouterr().out
        for option in options:
            assert re.search(rf"{option}\b", helps[key]), f"{key} has no option {option}"
        overrides = [value for word, value in pairwise(arguments) if word == "--set"]
        if overrides:
            base = next((word for word in arguments if word in base_names()), "recon_b")
            load_scenario(base, overrides)


def test_targets_that_are_shown_exist_and_do_what_is_said():
    recipes = dict(re.findall(r"^([\w-]+):.*\n((?:\t.*\n)*)", MAKEFILE, re.MULTILINE))
    for line in (line for line in SHOWN if line.startswith("make ")):
        for target in line.split()[1:]:
            assert target in recipes, f"{SHOWN[line]} shows {line}"
    readme = (PROJECT / "README.md").read_text("utf-8")
    for target, words in re.findall(r"make (\w+) +# set up, then: (?:python -m )?(.+)", readme):
        assert f"python -m {words}" in recipes[target]


WITHOUT_COMMAND = ("crosscheck", "docs", "notebooks", "peers", "test", "dev")


def test_one_target_installs_every_extra_that_a_command_may_need():
    """All but those of who works on this repository."""
    (everything,) = EXTRAS["all"]
    listed = re.findall(r"\w+", everything)
    assert listed[0] == PYPROJECT["name"]
    assert {*listed[1:]} == EXTRAS.keys() - {"all", *WITHOUT_COMMAND}
    assert re.search(r"^extras: \$\(VENV\)/\.extras ", MAKEFILE, re.MULTILINE)
    assert re.search(r"/\.extras: .*\n\t\$\(PIP\) --editable '\.\[all\]'", MAKEFILE)


def snippets_of(page: Path) -> dict[str, list[str]]:
    """TOML and Python of a page; what is neither shows what commands print, or is a mere comment."""
    found: dict[str, list[str]] = {"toml": [], "python": []}
    for block in blocks(page):
        if any(COMMAND.match(line) for line in block.splitlines()):
            continue
        for language, reader in (("toml", tomllib.loads), ("python", ast.parse)):
            with suppress(tomllib.TOMLDecodeError, SyntaxError):
                if reader(block):
                    found[language].append(block)
                break
        else:
            assert not re.search(r"^import |\bsr\.", block, re.MULTILINE), f"no Python: {block}"
    return found


def test_scenarios_that_are_shown_are_read(tmp_path):
    for block in (block for page in PAGES for block in snippets_of(page)["toml"]):
        if "campaign" in (tables := tomllib.loads(block)):
            assert len(Study.validated(tables).cases) > 1
            continue
        (tmp_path / "mine.toml").write_text(block, encoding="utf-8")
        assert load_scenario(tmp_path / "mine.toml") != load_scenario()


SHOWING_PYTHON = {page.name: found for page in PAGES if (found := snippets_of(page)["python"])}


@pytest.mark.parametrize("page", SHOWING_PYTHON)
def test_python_that_is_shown_runs(page, workspace, monkeypatch):
    """One snippet of a page after the other, as in one session, with fewer flights."""
    monkeypatch.chdir(workspace.folder)
    shutil.rmtree("runs/mine")  # commands and other pages may have written another plan there
    shutil.copytree("exported", "runs/mine")
    names: dict[str, object] = {}
    for block in SHOWING_PYTHON[page]:
        few = re.sub(r"samples=[\d_]+", "samples=500", block)
        exec(compile(few, page, "exec"), names)


def test_the_readme_shows_the_plan_of_its_command(workspace):
    shown = re.search(r"total delta-v (\S+) m/s", (PROJECT / "README.md").read_text("utf-8"))
    assert shown
    plan = read_solution(workspace.folder / "runs" / "default")
    assert plan.total_dv_m_s == pytest.approx(float(shown[1]), abs=5e-6)


def test_the_readme_shows_python_and_every_link_leads_somewhere():
    assert "README.md" in SHOWING_PYTHON
    for page in (*PAGES, PROJECT / "CHANGELOG.md", *(PROJECT / "docs").glob("reference/*.md")):
        for target in re.findall(r"\]\(([^)#]+)", page.read_text("utf-8")):
            assert target.startswith("https://") or (page.parent / target).exists(), (page, target)
