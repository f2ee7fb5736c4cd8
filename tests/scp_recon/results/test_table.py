"""One table: every renderer shows the same cells, people's texts or programs' values."""

import csv
import json
from io import StringIO

import pytest
from rich.console import Console

from scp_recon.cli.views import terminal
from scp_recon.display import digits
from scp_recon.results.table import Cell, Column, Table

MARGINS = Table.of(
    "Margins <of> a plan",
    ("constraint", Column("margin", "m/s", "+.2f"), Column("facets"), Column("kept")),
    [
        ("emission & more", 1.23456, 4, True),
        ("phase|x", Cell("lost", float("nan"), "bad"), None, False),
        ("a, b", -1e-9, 0, True),
    ],
    key="margins",
    note="0 is <kept>",
)


def test_texts_are_rounded_and_values_are_not():
    assert [row[1].text for row in MARGINS.rows] == ["+1.23", "lost", "+0.00"]
    assert MARGINS.rows[0][1].value == 1.23456
    assert [row[2].text for row in MARGINS.rows] == ["4", "", "0"]


def test_csv_holds_the_values_under_keys_with_units():
    assert list(csv.DictReader(StringIO(MARGINS.csv()))) == [
        {"constraint": "emission & more", "margin_m_s": "1.23456", "facets": "4", "kept": "true"},
        {"constraint": "phase|x", "margin_m_s": "nan", "facets": "", "kept": "false"},
        {"constraint": "a, b", "margin_m_s": "-1e-09", "facets": "0", "kept": "true"},
    ]


def test_records_are_json_whose_values_are_the_cells():
    found = json.loads(json.dumps(MARGINS.records(), allow_nan=False))
    keys = ["constraint", "margin_m_s", "facets", "kept"]
    assert found[0] == dict(zip(keys, ["emission & more", 1.23456, 4, True], strict=True))
    assert found[1]["margin_m_s"] is None


def test_html_escapes_and_gives_each_figure_its_value():
    html = MARGINS.html()
    assert '<table data-table="margins">' in html
    assert '<th scope="row">emission &amp; more</th>' in html
    assert '<td class="number" data-value="1.23456">+1.23</td>' in html
    assert '<td class="number bad" data-value="nan">lost</td>' in html
    assert '<p class="note">0 is &lt;kept&gt;</p>' in html
    assert "margin (m/s)" in html


def test_markdown_keeps_its_columns():
    assert MARGINS.markdown().splitlines()[:4] == [
        "| constraint | margin (m/s) | facets | kept |",
        "| --- | ---: | ---: | --- |",
        "| emission & more | +1.23 | 4 | True |",
        "| phase\\|x | lost |  | False |",
    ]


@pytest.mark.parametrize("narrow", [False, True])
def test_the_terminal_shows_texts_as_they_are(*, narrow):
    console = Console(file=StringIO(), width=100)
    console.print(terminal(MARGINS, narrow=narrow))
    said = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert "emission & more" in said[1 + narrow]
    assert ("margin m/s" in said[0]) is not narrow
    plain = str(MARGINS).splitlines()
    assert plain[1].split() == said[1 + narrow].split()


def test_a_column_is_written_as_read():
    assert Column.of("size (mm/s) +.3f") == Column("size", "m/s", "+.3f", shown_unit="mm/s")
    assert Column.of("closest 99.7 % (m)") == Column("closest 99.7 %", "m")
    assert Column.of("what happens") == Column("what happens")


def test_large_figures_have_no_exponent():
    column = Column("radius", "m/s", ".3g", shown_unit="mm/s")
    assert [column.cell(value).text for value in (1.84567, 0.9996, 0.0123, -123.4)] == [
        "1846",
        "1000",
        "12.3",
        "-123400",
    ]
    assert [digits(value, 4) for value in (999.96, 9999.6, 123456.7)] == ["1000", "10000", "123457"]
    assert digits(1.5e-7, 2) == "1.5e-07"
