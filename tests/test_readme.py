"""README and the first page run as shown; what other pages show is read against the commands' help."""

import ast
import importlib
import re
import shlex
import tomllib
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest
from markdown_it import MarkdownIt
from markdown_it.token import Token

from scp_recon.api.exploring import Server
from scp_recon.campaigns.study import Study
from scp_recon.results.read import read_solution
from scp_recon.scenario.load import base_names, load_scenario
from tests.helpers import nightly
from tests.scp_recon.support import fly_few

pytestmark = pytest.mark.slow

PROJECT = Path(__file__).parents[1]
MAKEFILE = (PROJECT / "Makefile").read_text("utf-8")
EXTRAS = tomllib.loads((PROJECT / "pyproject.toml").read_text("utf-8"))["project"][
    "optional-dependencies"
]
README, START = PROJECT / "README.md", PROJECT / "docs" / "start.md"
PAGES = [
    *(README, PROJECT / "CONTRIBUTING.md"),
    *sorted(p for p in (PROJECT / "docs").rglob("*.md") if p.parent.name != "reference"),
]
TEXTS = [*PAGES, PROJECT / "CHANGELOG.md", *(PROJECT / "docs" / "reference").glob("*.md")]
COMMAND = re.compile(r"(?:\S*python -m|make|scp-recon) \S.*")
MENTIONED = re.compile(r"`(scp-recon|pytest) ([^`]+)`")
RECIPE = re.compile(
    r"\$\(BIN\)/(python -m (?!pytest|scp_recon.reference).+?)(?= && | \|\| |$)", re.MULTILINE
)


@cache
def tokens_of(page: Path) -> list[Token]:
    """All tokens of a page, those within lines too."""
    tokens = MarkdownIt("commonmark").enable("table").parse(page.read_text("utf-8"))
    return [*tokens, *(child for token in tokens for child in token.children or ())]


def codes(page: Path, *kinds: str) -> list[str]:
    """Texts of a page's code of some kinds of tokens: its blocks, or what stands in its lines."""
    return [one.content for one in tokens_of(page) if one.type in kinds]


def blocks(page: Path) -> list[str]:
    """The code blocks of a page."""
    return codes(page, "fence", "code_block")


def lines_of(page: Path) -> list[str]:
    """Command lines of a page, without the interpreter's path."""
    parts = [part for block in blocks(page) for part in re.split(r" && |\n", block)]
    parts += [one for one in codes(page, "code_inline") if not one.startswith("scp-recon")]
    lines = [shlex.split(part, comments=True) for part in parts if COMMAND.fullmatch(part)]
    for words in lines:
        if words[0] != "make":
            words[:1] = ["python", "-m", "scp_recon"] if words[0] == "scp-recon" else ["python"]
    return [shlex.join(words) for words in lines]


SHOWN = {line: page.name for page in reversed(PAGES) for line in lines_of(page)}
RUN = [*dict.fromkeys(line for page in (README, START) for line in lines_of(page))]
FEWER = {"montecarlo": ["--until", "5%", "--samples", "2000"], "explore": ["--no-browser"]}
"""Options in addition, of which the last one of a name counts."""
LONG = ("simulate", "design", "allocation", "mission.toml", "new mission", "explore")
"""Words of lines that take a minute, and that other tests run every day with less work."""


def call(words: Sequence[str]) -> int:
    """Exit status of `python -m` with these words, in this process."""
    module, *arguments = words
    if module == "scp_recon.solve":  # which has no `main`, and is run as a program elsewhere
        module, arguments = "scp_recon", ["solve", *arguments]
    found = importlib.import_module(module)
    if hasattr(found, "__path__"):
        found = importlib.import_module(f"{module}.__main__")
    try:
        return int(found.main(arguments))
    except SystemExit as end:  # argparse ends this way
        return int(end.code or 0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The working folder of all lines, with the plan of `make solve`; verification flies little."""
    found = tmp_path_factory.mktemp("workspace")
    (found / "mine.toml").write_text(snippets_of(START, "toml")[0], "utf-8")
    axis = '[[axis]]\nentry = "observation.incidence_max_deg"\nvalues = [0.01, 0.02]\n'
    (found / "study.toml").write_text(axis, "utf-8")  # the site is never lit so well
    with pytest.MonkeyPatch.context() as patch:
        fly_few(patch)
        patch.chdir(found)
        patch.setattr(Server, "serve_forever", lambda *_: None)
        assert call(["scp_recon.solve", "--init", "cold"]) == 0
        assert call(["scp_recon.solve", "--out", "runs/default"]) == 0
        yield found


@pytest.mark.parametrize(
    "line",
    [
        pytest.param(line, marks=[nightly] if any(word in line for word in LONG) else [])
        for line in RUN
        if line.startswith("python -m scp_recon")
    ],
)
@pytest.mark.usefixtures("folder")
def test_shown_command_runs(line):
    """In the order of the pages, as a reader would."""
    words = shlex.split(line)[2:]
    assert call(words + FEWER.get(words[1], [])) == 0


def test_readme_shows_its_plan(folder):
    shown = re.search(r"total delta-v (\S+) mm/s", README.read_text("utf-8"))
    assert shown
    plan = read_solution(folder / "runs" / "default")
    assert 1e3 * plan.total_dv_m_s == pytest.approx(float(shown[1]), abs=5e-3)


def snippets_of(page: Path, language: str) -> list[str]:
    """The blocks of a page that are "toml", or "python"."""
    found: dict[str, list[str]] = {"toml": [], "python": []}
    for block in blocks(page):
        if any(COMMAND.match(line) for line in block.splitlines()):
            continue
        for name, reader in (("toml", tomllib.loads), ("python", ast.parse)):
            with suppress(tomllib.TOMLDecodeError, SyntaxError):
                if reader(block):
                    found[name].append(block)
                break
        else:
            assert not re.search(r"^import |\bsr\.", block, re.MULTILINE), f"no Python: {block}"
    return found[language]


def test_shown_scenarios_are_read(tmp_path):
    for block in (block for page in PAGES for block in snippets_of(page, "toml")):
        if "campaign" in (tables := tomllib.loads(block)):
            assert len(Study.validated(tables).cases) > 1
            continue
        (tmp_path / "mine.toml").write_text(block, encoding="utf-8")
        assert load_scenario(tmp_path / "mine.toml") != load_scenario()


@pytest.mark.parametrize(
    "page", [page for page in PAGES if snippets_of(page, "python")], ids=lambda page: page.stem
)
@pytest.mark.usefixtures("folder")
def test_shown_python_runs(page):
    """One snippet of a page after the other, as in one session, with fewer flights."""
    if page.stem == "export":
        pytest.importorskip("spiceypy", reason="needs the extra [spice]")
        for form in ("spk", "ck"):
            assert call(["scp_recon", "export", "runs/default", "--format", form]) == 0
    names: dict[str, object] = {}
    for block in snippets_of(page, "python"):
        few = re.sub(r"samples=[\d_]+", "samples=500", block).replace("runs/mine/", "runs/default/")
        exec(compile(few, page.name, "exec"), names)


def test_shown_modules_options_files_exist(capsys, monkeypatch, pytestconfig):
    monkeypatch.setenv("COLUMNS", "200")
    said = sorted({pair for page in TEXTS for pair in MENTIONED.findall(page.read_text("utf-8"))})
    lines = [f"python -m {name.replace('-', '_')} {rest}" for name, rest in said]
    lines += [line for line in SHOWN if line.startswith("python ")] + RECIPE.findall(MAKEFILE)
    helps: dict[tuple[str, ...], str] = {}
    for line in lines:
        module, *arguments = shlex.split(line)[2:]
        options = [word.partition("=")[0] for word in arguments if word.startswith("--")]
        for name in (word for word in arguments if word.startswith("examples/")):
            tables = tomllib.loads((PROJECT / name).read_text("utf-8"))
            for axis in tables["axis"]:  # a few days have a window of each kind as well
                axis.get("windows", {}).update(span_days=3, every=1)
            assert len(Study.validated(tables).cases) > 1
        if module == "pip":
            assert (PROJECT / arguments[arguments.index("--constraint") + 1]).exists()
            assert {*re.findall(r"\[(\w+)\]", line)} <= EXTRAS.keys()
        elif module == "pytest":
            assert all(pytestconfig.getoption(option) is not None for option in options)
        else:
            of = arguments[:1] if module in ("scp_recon", "experiments") else []
            if (key := (module, *of)) not in helps and of != ["NAME"]:
                assert call([*key, "--help"]) == 0, line
                helps[key] = capsys.readouterr().out
            missing = [one for one in options if not re.search(rf"{one}\b", helps[key])]
            assert not missing, line
            overrides = [value for word, value in pairwise(arguments) if word == "--set"]
            base = next((word for word in arguments if word in base_names()), "recon_b")
            load_scenario(base, overrides)


def test_shown_targets_exist():
    recipes = dict(re.findall(r"^([\w-]+):.*\n((?:\t.*\n)*)", MAKEFILE, re.MULTILINE))
    for line in (line for line in SHOWN if line.startswith("make ")):
        assert {*line.split()[1:]} <= recipes.keys(), f"{SHOWN[line]} shows {line}"
    said = re.findall(r"make (\w+) +# set up, then: (?:python -m )?(.+)", README.read_text("utf-8"))
    assert all(f"python -m {words}" in recipes[target] for target, words in said)


def test_links_lead_somewhere():
    for page in TEXTS:
        for target in re.findall(r"\]\(([^)#]+)", page.read_text("utf-8")):
            assert target.startswith("https://") or (page.parent / target).exists(), (page, target)
