"""README and docs: their tables are the evidence's, and so are the figures in their text."""

import re

import pytest

from experiments import evidence, pages
from experiments.evidence import ROOT, SOURCES, Evidence, path_of
from scp_recon.errors import InputError

PAGES = {page.relative_to(ROOT).as_posix(): page.read_text("utf-8") for page in pages.PAGES}


FIGURE = re.compile(r"\b\d{1,2}\.\d{4,}\b")
"""More digits than anybody chooses."""


@pytest.mark.parametrize("page", PAGES)
def test_results_in_the_text_have_a_claim(page):
    text = pages.BLOCK.sub("", PAGES[page])
    text = re.sub(r"```.*?```|^ {4}.*?$|`[^`]*`", "", text, flags=re.DOTALL | re.MULTILINE)
    text = " ".join(text.split())
    for phrase in pages._read(pages.CLAIMS).get(page, ()):
        text = text.replace(phrase, "")
    assert FIGURE.findall(text) == []


def test_pages_show_all_evidence_as_it_is():
    assert list(pages.wrong_claims()) == []
    assert [*pages.behind()] == [], "run `python -m experiments evidence --render`"
    texts = "".join(PAGES.values())
    drawn = {name for name, source in SOURCES.items() if source.figures}
    used = re.findall(r"<!-- table (\w+)|", texts) + re.findall(
        r"'(\w+)(?:\.\w+)?\[", pages.CLAIMS.read_text("utf-8")
    )
    assert drawn | {*filter(None, used)} == set(SOURCES)
    shown = {block[1] for text in PAGES.values() for block in pages.BLOCK.finditer(text)}
    of = pages._read(pages.TABLES)
    assert shown == {f"{name}.{table}" for name, tables in of.items() for table in tables}
    assert "<!--" not in PAGES["README.md"]


def test_the_page_on_the_paper_counts_its_outcomes():
    text = PAGES["docs/validation/paper.md"]
    outcomes, reproduced = list[str](), list[str]()
    for table in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        head, _, *rows = (
            [cell.strip(" |") for cell in line.split(" | ")] for line in table.splitlines()
        )
        for column, found in (("outcome", outcomes), ("reproduced", reproduced)):
            found += [row[head.index(column)] for row in rows] if column in head else []
    both = sum("same" in one and "opposite" in one for one in outcomes)
    of = (sum(word in one for one in outcomes) for word in ("same", "opposite", "not comparable"))
    same, opposite, other = of
    counts = (len(outcomes), same - both, opposite - both, other, both)
    plain = " ".join(text.split())
    said = re.search(r"In short: of the .*?\*mixed\*", plain)
    assert said
    assert tuple(map(int, re.findall(r"\d+", said[0]))) == counts
    printed, yes = len(reproduced), reproduced.count("yes")
    assert f"Of the {printed} printed numbers of Section VII {yes} are reproduced" in plain


ROWS = [
    {"kind": "exact", "asked": 0.9, "dv": 0.11019, "ok": True, "note": None},
    {"kind": "exact", "asked": 0.99, "dv": 0.13016, "ok": False, "note": "1 of 20 late"},
    {"kind": "even", "asked": 0.9, "dv": "infeasible", "ok": None, "note": ""},
]


@pytest.fixture
def rows(tmp_path, monkeypatch) -> None:
    """Evidence, and a page of a phrase a line, in the folder of this test."""
    other = Evidence.read(path_of("plans"))
    monkeypatch.setattr(evidence, "FOLDER", tmp_path)
    monkeypatch.setattr(pages, "ROOT", tmp_path)
    monkeypatch.setattr(pages, "PAGES", (tmp_path / "page.md",))
    for name in ("CLAIMS", "TABLES"):
        monkeypatch.setattr(pages, name, tmp_path / f"{name.lower()}.toml")
    tables = {"plans": ROWS, "more": ROWS[:1]}
    other.model_copy(update={"tables": tables}).write(path_of("plans"))
    pages._tables.cache_clear()
    yield
    pages._tables.cache_clear()


@pytest.mark.parametrize(
    ("table", "shown"),
    [
        (
            'where = "kind=exact"\ncolumns = "p = asked:g | dv mm/s = dv*1e3:.2f | ok"',
            "| p | dv mm/s | ok |\n| ---: | ---: | --- |\n"
            "| 0.9 | 110.19 | yes |\n| 0.99 | 130.16 | no |",
        ),
        ('of = "more"\ncolumns = "kind | note"', "| kind | note |\n| --- | ---: |\n| exact |  |"),
        ('where = "kind^=ev"\ncolumns = "dv:.2f"', "| dv |\n| --- |\n| infeasible |"),
    ],
)
@pytest.mark.usefixtures("rows")
def test_a_table_block_is_filled_once(table, shown):
    pages.TABLES.write_text(f"[plans.plans]\n{table}\n", "utf-8")
    text = "before\n\n<!-- table plans.plans -->\n<!-- end -->\n\nafter"
    once = pages.render(text)
    assert once == text.replace(" -->\n<", f" -->\n\n{shown}\n\n<")
    assert pages.render(once) == once


@pytest.mark.usefixtures("rows")
def test_a_table_of_no_row_is_refused():
    pages.TABLES.write_text('[plans.plans]\nwhere = "kind=none"\ncolumns = "dv"\n', "utf-8")
    with pytest.raises(InputError, match=r"plans\.plans: got"):
        pages.table("plans.plans")
    with pytest.raises(InputError, match="other"):
        pages.table("plans.other")


@pytest.mark.parametrize(
    ("phrase", "values", "wrong"),
    [
        ("costs 0.110 m/s", "plans[exact 0.9].dv", ""),
        ("costs 110.2 mm/s, P2", "plans[kind=exact; asked=0.9].dv * 1e3", ""),
        ("costs 0.12 m/s", "plans.more[exact].dv +- 0.01", ""),
        ("1.18 times", "plans[exact 0.99].dv / plans[exact 0.9].dv", ""),
        ("1 of 20", "plans[exact 0.99].note", ""),
        ("infeasible by even split", "plans[kind^=ev].dv", ""),
        ("costs 0.111 m/s", "plans[exact 0.9].dv", "0.111 is 0.11019"),
        ("feasible", "plans[even].dv", "must stand in the phrase"),
        ("1 and 2", "plans[exact 0.9].dv", "has 2 figures, the evidence 1"),
        ("0.9", "plans[none].dv", "plans[none].dv: got 0 rows"),
        ("0.9", "plans[even].cost", "must be one of kind, asked"),
        ("0.9", "plans[exact 0.9].dv +- much", "must be"),
    ],
)
@pytest.mark.usefixtures("rows")
def test_a_claim_agrees_or_says_why(phrase, values, wrong):
    pages.PAGES[0].write_text("\n".join(["before", *phrase.split(), "after"]), "utf-8")
    pages.CLAIMS.write_text(f"['page.md']\n'{phrase}' = '{values}'\n", "utf-8")
    said = list(pages.wrong_claims())
    assert bool(said) == bool(wrong)
    assert all(f"claims.toml: page.md: {phrase!r}: " in line for line in said)
    assert all(wrong in line and "\n" not in line for line in said)


@pytest.mark.parametrize(("phrase", "times"), [("gone 0.11", 0), ("0.11", 2)])
@pytest.mark.usefixtures("rows")
def test_a_phrase_stands_once_in_its_page(phrase, times):
    pages.PAGES[0].write_text("one 0.11 and 0.11", "utf-8")
    pages.CLAIMS.write_text(f"['page.md']\n'{phrase}' = 'plans[exact 0.9].dv'\n", "utf-8")
    (line,) = pages.wrong_claims()
    assert f"{times} times" in line
