"""The house's floors: who may import whom, and the library's manners at import."""

import ast
import re
import subprocess
import sys
from collections.abc import Set
from functools import cache
from pathlib import Path

import pytest

from scp_recon.cli.commands import COMMANDS as BY_NAME

PROJECT = Path(__file__).parents[2]
LIBRARY = ("formulations", "scp_recon")
UPPER_FLOORS = ("tests", "experiments", "paper_figs", "benchmarks")
WINGS = (*LIBRARY, "experiments", "paper_figs", "benchmarks")


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(PROJECT).with_suffix("").parts).removesuffix(".__init__")


def modules(package: str) -> list[Path]:
    found = sorted((PROJECT / package).rglob("*.py"))
    assert len(found) > 2
    return found


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"))


@cache
def imports(path: Path, *, at_import: bool = False) -> frozenset[str]:
    """Every module that a file imports, wherever in the file; or at import only."""
    tree = parsed(path)
    nodes = tree.body if at_import else list(ast.walk(tree))
    found: set[str] = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            assert node.module is not None
            # `from package import module` names the module in the second place.
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(found)


def roots(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imports(path)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("package", "barred"),
    [
        ("formulations", {"scp_recon", *UPPER_FLOORS}),
        ("formulations", {"json", "tomllib", "csv", "pathlib", "pydantic", "rich"}),
        ("scp_recon", set(UPPER_FLOORS)),
    ],
)
def test_a_wing_imports_nothing_above_it_and_formulations_no_file_format(package, barred):
    found = {module_name(path): roots(path) & barred for path in modules(package)}
    assert {name: wrong for name, wrong in found.items() if wrong} == {}


FLOORS = (
    "formulations.arrays",
    "formulations.risk",
    "formulations.problem",
    "formulations.linearisation",
    "formulations.rows",
    "formulations.program",
    "formulations.nlp",
    "formulations.registry",
    "scp_recon.scp",  # of any flow: below the physics of one
    "scp_recon.errors",
    "scp_recon.files",
    "scp_recon.display",
    "scp_recon.jobs",
    "scp_recon.bodies",
    "scp_recon.scenario",
    "scp_recon.physics",
    "scp_recon.mission",
    "scp_recon.drafting",
    "scp_recon.planning",
    "scp_recon.results",
    "scp_recon.monte_carlo",
    "scp_recon.simulation",
    "scp_recon.simulation.basilisk",
    "scp_recon.verification",
    "scp_recon.certification",
    "scp_recon.impulsive",
    "scp_recon.interop",
    "scp_recon.passes",
    "scp_recon.replanning",
    "scp_recon.reports",
    "scp_recon.campaigns",
    "scp_recon.api",
    "scp_recon.advice",
    "scp_recon.cli",
    "scp_recon.cli.commands",
    "scp_recon",  # the lazy names, and the ways in
    "experiments.evidence",
    "experiments.harness",
    "experiments.solvers.cases",
    "experiments.solvers.cells",
    "experiments",
    "paper_figs.inputs",
    "paper_figs.drawing",
    "paper_figs.observation",
    "paper_figs",
    "benchmarks",
)
"""Folders, and modules that stand alone, from the lowest up: CONTRIBUTING's tree read backwards."""
TREE = (PROJECT / "CONTRIBUTING.md").read_text("utf-8").split("## The house")[1]
PACKAGES = {"scp_recon", *UPPER_FLOORS}
"""By their own name no more than the package around what is imported of it."""


def floor_of(module: str) -> str | None:
    """The deepest folder or module of the floors that a module is in."""
    found = [name for name in FLOORS if f"{module}.".startswith(f"{name}.")]
    return max(found, key=len, default=None)


def floors_above(own: str, imported: Set[str]) -> set[str]:
    """Those of the imported modules that are above one's own floor."""
    floors = {floor for name in imported - PACKAGES if (floor := floor_of(name))}
    return {floor for floor in floors if FLOORS.index(floor) > FLOORS.index(own)}


COMMANDS = {module_name(path) for path in modules("scp_recon/cli")}
NEEDED = {name for path in modules("scp_recon/cli/commands") for name in imports(path)} & {
    module_name(path) for path in modules("scp_recon")
}
"""What commands import when they are called."""


@pytest.mark.slow
def test_folders_import_downwards_only():
    upwards = {}
    for path in (path for package in WINGS for path in modules(package)):
        own = floor_of(name := module_name(path))
        if own is None:
            assert path.name == "__init__.py", path
        elif above := floors_above(own, imports(path)):
            upwards[name] = above
    assert upwards == {}


def test_only_the_packages_face_imports_by_name():
    named = {p for p in modules("scp_recon") if 'import_module("' in p.read_text("utf-8")}
    assert {module_name(path) for path in named} == {"scp_recon"}


def test_of_the_api_one_module_alone_plans():
    """Every other way to a plan goes through it, so that all of them decide alike."""
    api = {path.stem: imports(path) for path in modules("scp_recon/api")}
    assert [name for name in api if "scp_recon.planning.planner" in api[name]] == ["planning"]


def test_every_module_and_command_has_its_floor():
    """Commands are above all of their wing but the ways in, so that nothing below imports them."""
    assert floors_above("scp_recon.api", COMMANDS) == {"scp_recon.cli", "scp_recon.cli.commands"}
    assert not floors_above("scp_recon.cli", {"scp_recon", "scp_recon.errors"})
    files = [path for package in WINGS for path in modules(package)]
    floors = {floor_of(module_name(path)) for path in files}
    assert floors - {None} == set(FLOORS)


@pytest.mark.parametrize("wing", LIBRARY)
def test_the_drawn_tree_is_the_house_from_the_top_down(wing):
    """A wing's folders stand six spaces in, those of the floors and in their order."""
    drawn = re.findall(r"^ {6}(\w+)/", TREE.split(f"\n    {wing}/ ")[1].split("\n\n")[0], re.M)
    inside = [floor.split(".")[1:] for floor in FLOORS if floor.startswith(f"{wing}.")]
    folders = [names[0] for names in inside if (PROJECT / wing / names[0]).is_dir()]
    assert [name for name in drawn if name != "data"] == list(dict.fromkeys(reversed(folders)))


@pytest.mark.parametrize("wing", WINGS[:-1])
def test_the_drawn_tree_names_every_folder_and_study(wing):
    named = set(re.findall(r"\w+", TREE))
    for path in modules(wing):
        *folders, module = path.relative_to(PROJECT / wing).with_suffix("").parts
        alone = [] if folders or wing in LIBRARY or module.startswith("__") else [module]
        assert {*folders[: 2 if wing in LIBRARY else 1], *alone} <= named, path


def test_the_drawn_tree_names_every_command():
    first = TREE.split("\n    scp_recon/ ")[1].split("api/")[0]
    assert {*BY_NAME} <= {*first.split()}


@pytest.mark.parametrize("wing", WINGS[2:])
def test_studies_figures_and_timings_use_the_library_and_not_each_other(wing):
    """But for the harness, by which timings are a study as well."""
    others = tuple(f"{other}." for other in UPPER_FLOORS if other != wing)
    for path in modules(wing):
        used = {name for name in imports(path) if f"{name}.".startswith(others)}
        assert all(f"{name}.".startswith("experiments.harness.") for name in used), path


def test_there_are_no_circles():
    graph = {module_name(path): imports(path) for wing in WINGS for path in modules(wing)}
    graph = {name: targets & graph.keys() - {name} for name, targets in graph.items()}
    # A package that only holds its docstring is no room.
    while ground := [name for name, targets in graph.items() if not targets]:
        graph = {name: graph[name] - {*ground} for name in graph if name not in ground}
    assert not graph, f"circle among {sorted(graph)}"


@pytest.mark.slow
def test_the_library_neither_prints_nor_asks_nor_sets_anything_global():
    for path in (path for package in LIBRARY for path in modules(package)):
        text, nodes = path.read_text("utf-8"), list(ast.walk(parsed(path)))
        for setting in ("np.seterr(", "np.random.seed(", "warnings.simplefilter(", "os.environ["):
            assert setting not in text, path
        calls = {node: ast.unparse(node.func) for node in nodes if isinstance(node, ast.Call)}
        assert not {*calls.values()} & {"print", "input", "breakpoint"}, path
        assert not any(isinstance(node, ast.Global) for node in nodes), path
        filters = {node for node, name in calls.items() if name == "warnings.filterwarnings"}
        guarded = {
            inside
            for node in nodes
            if filters and isinstance(node, ast.With)
            if "catch_warnings" in ast.unparse(node.items[0])
            for inside in ast.walk(node)
        }
        assert filters <= guarded, f"{path}: a warnings filter outside catch_warnings"


def run_python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        cwd=PROJECT,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )


QUIET_IMPORT = """
import importlib, random, sys, warnings
import clarabel, cvxpy, numpy as np, pydantic, rich.console, rich.live, scipy.integrate
import scipy.interpolate, scipy.optimize, scipy.spatial, scipy.stats
def state():
    return [np.geterr(), list(map(repr, warnings.filters)), np.get_printoptions(),
            repr(np.random.get_state()), repr(random.getstate()), repr(sys.excepthook)]
before = state()
for name in {modules}:
    importlib.import_module(name)
after = state()
assert before == after, [(a, b) for a, b in zip(before, after) if a != b]
"""


@pytest.mark.slow
def test_importing_the_library_is_silent_and_changes_nothing_global():
    files = {module_name(path): path for package in LIBRARY for path in modules(package)}
    optional = {"casadi", "matplotlib", "spiceypy", "Basilisk"}

    def everything(name: str, seen: set[str]) -> set[str]:
        """What importing a module imports, through the library's own modules."""
        if name in files and name not in seen:
            seen.add(name)
            for other in imports(files[name], at_import=True):
                everything(other, seen)
        seen.add(name.split(".")[0])
        return seen

    needed = [name for name in files if not everything(name, set()) & optional]
    assert set(needed) >= COMMANDS | {
        "formulations.program.subproblem",
        "scp_recon.planning.planner",
    }
    run = run_python(QUIET_IMPORT.format(modules=needed))
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


HEAVY = (
    *("casadi", "matplotlib", "spiceypy", "pandas", "Basilisk", "ipywidgets", "hypothesis"),
    *("oem", "astropy", "pyarrow", "distributed"),
)
ONE_BY_ONE = f"""
import importlib, sys
for name in {{commands!r}}:
    importlib.import_module(name)
    if found := sorted(set({HEAVY}) & set(sys.modules)):
        sys.exit(f"{{{{name}}}} imports {{{{found}}}}")
"""


@pytest.mark.slow
def test_the_main_job_needs_nothing_heavy_at_import():
    """Of no command: what the first imports has no part in what the next is found to."""
    run = run_python(ONE_BY_ONE.format(commands=sorted(COMMANDS | NEEDED)))
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


TO_PLAN = ("cvxpy", "clarabel", *HEAVY)
"""What planning takes: who reads a plan need not wait for it."""
READ = f"""
import sys
from scp_recon.cli.commands import report, solve, verify
def check(name, heavy):
    if found := sorted(set(heavy) & set(sys.modules)):
        sys.exit(f"{{{{name}}}} imports {{{{found}}}}")
try:
    solve.main(["--help"])
except SystemExit:
    check("--help", {("numpy", "scipy", "pydantic", "rich", *TO_PLAN)})
for command, heavy in ((verify, {("jinja2", *TO_PLAN)}), (report, {TO_PLAN})):
    assert command.main([{{folder!r}}, "--quiet"]) == 0
    check(command.name, heavy)
"""


@pytest.mark.slow
def test_help_verification_and_a_report_load_nothing_heavy(solution, tmp_path):
    """In this order: what one imports the next may too."""
    solution.write(tmp_path)
    run = run_python(READ.format(folder=str(tmp_path)))
    assert run.returncode == 0, run.stderr
