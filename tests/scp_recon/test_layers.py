"""The house's floors, as CONTRIBUTING draws them: who may import whom, and manners at import."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

from scp_recon.cli.commands import COMMANDS as BY_NAME
from tests.scp_recon.support import PROJECT, run_python

LIBRARY = ("formulations", "scp_recon")
UPPER_FLOORS = ("tests", "experiments", "paper_figs", "benchmarks")
WINGS = (*LIBRARY, *UPPER_FLOORS[1:])
TREE = (PROJECT / "CONTRIBUTING.md").read_text("utf-8").split("## The house")[1]


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(PROJECT).with_suffix("").parts).removesuffix(".__init__")


def modules(*packages: str) -> list[Path]:
    return [path for name in packages for path in sorted((PROJECT / name).rglob("*.py"))]


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text("utf-8"))


@cache
def imports(path: Path, *, at_import: bool = False) -> frozenset[str]:
    """Every module that a file imports, wherever in the file; or at import only."""
    tree = parsed(path)
    found: set[str] = set()
    for node in tree.body if at_import else ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            assert node.module is not None
            # `from package import module` names the module in the second place.
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return frozenset(found)


def floors() -> dict[str, int]:
    """Folders and modules of the tree with their heights; a folder within one is above it."""
    found: list[list[str]] = []  # from the top down
    for wing in reversed(LIBRARY):
        for line in TREE.split(f"\n    {wing}/ ")[1].split("\n\n")[0].splitlines()[1:]:
            names = re.match(r" {6}(?:(\w+)/|(\w+(?:  \w+)*)(?:   |$))", line)
            if names:
                found.append([f"{wing}.{name}" for name in (names[1] or names[2]).split("  ")])
            elif inner := re.match(r" {8}(\w+)/", line):
                found.insert(-1, [f"{found[-1][0]}.{inner[1]}"])
    heights = {name: k for k, names in enumerate(reversed(found)) for name in names}
    return heights | {"scp_recon.__main__": len(found)}


FLOORS = floors()


def floor_of(module: str) -> str | None:
    """The deepest folder or module of the tree that a module is in."""
    return max(
        (name for name in FLOORS if f"{module}.".startswith(f"{name}.")), key=len, default=None
    )


def higher(floor: str, own: str | None) -> bool:
    return own is None or FLOORS[floor] > FLOORS[own]


@pytest.mark.slow
def test_folders_import_downwards_only():
    upwards = {}
    for path in modules(*LIBRARY):
        own = floor_of(module_name(path))
        assert own or path.name == "__init__.py", f"{path} is not drawn in CONTRIBUTING"
        targets = imports(path) if own else frozenset()
        above = {floor for name in targets if (floor := floor_of(name)) and higher(floor, own)}
        above |= {name.split(".")[0] for name in targets} & {*UPPER_FLOORS}
        if above:
            upwards[module_name(path)] = above
    assert upwards == {}
    barred = {"scp_recon", "json", "tomllib", "csv", "pathlib", "pydantic", "rich"}
    for path in modules("formulations"):  # no file and no mission
        assert not {name.split(".")[0] for name in imports(path)} & barred, path
    for wing in WINGS[2:]:  # studies, figures and timings use the library and the harness alone
        others = tuple(f"{other}." for other in UPPER_FLOORS if other != wing)
        for name in set().union(*map(imports, modules(wing))):
            assert not f"{name}.".startswith(others) or "experiments.harness." in f"{name}.", wing


def test_the_tree_draws_every_folder_study_and_command():
    drawn = set(re.findall(r"\w+", TREE))
    for wing in WINGS:
        for path in modules(wing):
            *folders, module = path.relative_to(PROJECT / wing).with_suffix("").parts
            alone = [] if folders or wing in LIBRARY or module.startswith("__") else [module]
            assert {*folders[: 2 if wing in LIBRARY else 1], *alone} <= drawn | {"micro", "methods"}
    assert {*BY_NAME} <= {*TREE.split("\n    scp_recon/ ")[1].split("api/")[0].split()}
    assert all(
        (PROJECT / name.replace(".", "/")).with_suffix("").parent.is_dir() for name in FLOORS
    )


def test_of_the_api_one_module_alone_plans():
    """Every other way to a plan goes through it, so that all of them decide alike."""
    api = {path.stem: imports(path) for path in modules("scp_recon/api")}
    assert [name for name in api if "scp_recon.planning.planner" in api[name]] == ["planning"]
    named = {p for p in modules("scp_recon") if 'import_module("' in p.read_text("utf-8")}
    assert {module_name(path) for path in named} == {"scp_recon"}, "imports by name hide a floor"


def test_there_are_no_circles():
    graph = {module_name(path): imports(path) for path in modules(*WINGS)}
    graph = {name: targets & graph.keys() - {name} for name, targets in graph.items()}
    # A package that only holds its docstring is no room.
    while ground := [name for name, targets in graph.items() if not targets]:
        graph = {name: graph[name] - {*ground} for name in graph if name not in ground}
    assert not graph, f"circle among {sorted(graph)}"


@pytest.mark.slow
def test_library_neither_prints_nor_sets_global_state():
    settings = ("np.seterr(", "np.random.seed(", "warnings.simplefilter(", "os.environ[")
    for path in modules(*LIBRARY):
        nodes = list(ast.walk(parsed(path)))
        assert not [one for one in settings if one in path.read_text("utf-8")], path
        calls = {node: ast.unparse(node.func) for node in nodes if isinstance(node, ast.Call)}
        assert not {*calls.values()} & {"print", "input", "breakpoint"}, path
        assert not any(isinstance(node, ast.Global) for node in nodes), path
        blocks = (node for node in nodes if isinstance(node, ast.With))
        caught = (one for one in blocks if "catch_warnings" in ast.unparse(one.items[0]))
        guarded = {inside for block in caught for inside in ast.walk(block)}
        filters = {node for node, name in calls.items() if name == "warnings.filterwarnings"}
        assert filters <= guarded, f"{path}: a warnings filter outside catch_warnings"


def run_in_silence(code: str) -> None:
    run = run_python("-W", "error", "-c", code)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


HEAVY = (
    *("casadi", "matplotlib", "spiceypy", "pandas", "Basilisk", "ipywidgets", "hypothesis"),
    *("oem", "astropy", "pyarrow", "distributed"),
)
COMMANDS = {module_name(path) for path in modules("scp_recon/cli")}
NEEDED = imports(PROJECT / "scp_recon/cli/commands.py") & {
    module_name(path) for path in modules("scp_recon")
}
"""What commands import when they are called."""
QUIET_IMPORT = f"""
import importlib, random, sys, warnings
import clarabel, cvxpy, numpy as np, pydantic, rich.console, rich.live, scipy.integrate
import scipy.interpolate, scipy.optimize, scipy.spatial, scipy.stats
def state():
    return [np.geterr(), list(map(repr, warnings.filters)), np.get_printoptions(),
            repr(np.random.get_state()), repr(random.getstate()), repr(sys.excepthook)]
before = state()
for name in {{modules}}:
    importlib.import_module(name)
    if found := sorted(set({HEAVY}) & set(sys.modules)):
        sys.exit(f"{{{{name}}}} imports {{{{found}}}}")
after = state()
assert before == after, [(a, b) for a, b in zip(before, after) if a != b]
"""


@pytest.mark.slow
def test_commands_import_in_silence_and_nothing_heavy():
    """What the first imports has no part in what the next is found to."""
    run_in_silence(QUIET_IMPORT.format(modules=sorted(COMMANDS | NEEDED)))


TO_PLAN = ("cvxpy", "clarabel", *HEAVY)
"""What planning takes: who reads a plan need not wait for it."""
READ = f"""
import contextlib, io, sys
from scp_recon.cli.commands import report, solve, verify
def check(name, heavy):
    if found := sorted(set(heavy) & set(sys.modules)):
        sys.exit(f"{{{{name}}}} imports {{{{found}}}}")
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    solve.main(["--help"])
check("--help", {("numpy", "scipy", "pydantic", "rich", *TO_PLAN)})
for command, heavy in ((verify, {("jinja2", *TO_PLAN)}), (report, {TO_PLAN})):
    assert command.main([{{folder!r}}, "--quiet"]) == 0
    check(command.name, heavy)
"""


@pytest.mark.slow
def test_help_verification_and_a_report_load_nothing_heavy(solution, tmp_path):
    """In this order: what one imports the next may too."""
    solution.write(tmp_path)
    run_in_silence(READ.format(folder=str(tmp_path)))
