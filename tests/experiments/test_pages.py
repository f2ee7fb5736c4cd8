"""Pages show what the evidence says: every mark is filled, and no figure of a plan is typed."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from experiments import evidence, pages
from experiments.evidence import ROOT, SOURCES, Evidence, path_of
from scp_recon.errors import InputError

FIGURE = re.compile(r"\b\d{1,2}\.\d{4,}\b")
"""More digits than anybody chooses."""
SPEED = re.compile(r"<!--= (On one machine, .*?) -->", re.DOTALL)


@pytest.mark.parametrize("page", pages.PAGES, ids=lambda page: page.name)
def test_a_page_is_current_and_no_result_is_typed(page: Path) -> None:
    text = page.read_text("utf-8")
    assert pages.render(text) == text, "run `python -m experiments evidence --render`"
    typed = re.sub(r"```.*?```|^ {4}.*?$|`[^`]*`", "", pages.MARK.sub("", text), flags=re.S | re.M)
    assert FIGURE.findall(typed) == [], "a result has to come from the evidence"


def test_every_evidence_is_shown() -> None:
    shown = {name for page in pages.PAGES for name in pages.used(page.read_text("utf-8"))}
    assert shown == set(SOURCES)


def test_pages_that_speak_of_speed_say_the_same() -> None:
    said = [mark for page in pages.PAGES for mark in SPEED.findall(page.read_text("utf-8"))]
    assert len(said) >= 2
    assert len(set(said)) == 1
    assert SPEED.search((ROOT / "README.md").read_text("utf-8"))


ROWS = [
    {"kind": "exact", "asked": 0.9, "dv": 0.11019, "ok": True, "note": None},
    {"kind": "exact", "asked": 0.99, "dv": 0.13016, "ok": False, "note": "late"},
    {"kind": "even", "asked": 0.9, "dv": "infeasible", "ok": None, "note": ""},
]


@pytest.fixture
def rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evidence, "FOLDER", tmp_path)
    monkeypatch.setattr(pages, "_tables", pages._tables.__wrapped__)
    tables = {"plans": ROWS, "more": ROWS[:1]}
    Evidence("", "", "", "", {}, "", 1.0, resumed=False, tables=tables).write(path_of("plans"))


@pytest.mark.parametrize(
    ("template", "filled"),
    [
        ("{plans[exact 0.9].dv:.4f} m/s", "0.1102 m/s"),
        ("{plans[kind=exact; asked=0.99].dv:*1e3 .2f} mm/s", "130.16 mm/s"),
        ("{plans.more[exact].dv:.2f}", "0.11"),
        ("{plans[even].dv:.4f}", "infeasible"),
        ("{plans[exact 0.99].note}, {plans[exact 0.9].note}", "late, "),
        ("{plans[exact 0.9].ok} {plans[exact 0.99].ok}", "yes no"),
        ("{plans[kind^=ev].dv}", "infeasible"),
        (
            "plans kind=exact\n| p |\n| {asked:g} of {plans[even].asked:g} |\n",
            "\n| p |\n| 0.9 of 0.9 |\n| 0.99 of 0.9 |\n",
        ),
        ("\nall {plans[even].kind}\n", "\nall even\n"),
    ],
)
@pytest.mark.usefixtures("rows")
def test_a_template_is_filled(template: str, filled: str) -> None:
    head = template if "\n" in template else f" {template} "
    text = f"before <!--={head}-->old<!--/--> after"
    once = pages.render(text)
    assert once == f"before <!--={head}-->{filled}<!--/--> after"
    assert pages.render(once) == once
    assert pages.used(text) == ["plans"]


@pytest.mark.parametrize(
    ("template", "said"),
    [
        (" {plans[exact].dv} ", "2 rows"),
        (" {plans[none].dv} ", "0 rows"),
        (" {plans[even].cost} ", "must be one of kind, asked"),
        (" {plans.less[even].dv} ", "must be one of plans, more"),
        (" {others[even].dv} ", "no such evidence"),
        ("plans kind=none\n{asked}\n", "no row"),
    ],
)
@pytest.mark.usefixtures("rows")
def test_what_no_evidence_has_is_told(template: str, said: str) -> None:
    with pytest.raises(InputError, match=re.escape(said)):
        pages.render(f"<!--={template}--><!--/-->")
