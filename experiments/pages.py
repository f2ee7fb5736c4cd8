"""Render the figures of pages from evidence.

A mark in a page is a comment with a template, what the template gives, and an end:

    <!--= {plans[default].total_dv_m_s:.4f} m/s -->0.1401 m/s<!--/-->

A field is EVIDENCE[KEY].COLUMN or EVIDENCE.TABLE[KEY].COLUMN; the table is by default that of the
evidence's name. The key is the start of the row, the texts of its first cells with spaces between,
or conditions on columns, `kind=exact; asked=0.9` (`line^=P2` is one on how a text begins). A
template of several lines begins with a table and conditions, or with nothing; its lines whose
fields are mere columns are repeated for each row:

    <!--= frontier kind=exact|certified
    | asked | delta-v m/s |
    |---|---|
    | {asked} | {total_dv_m_s:.5f} |
    -->
    ...
    <!--/-->

Formats are Python's, after a factor if there is one, as in `{share:*100 .1f}`. Texts are not
changed, and missing values are left empty.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from string import Formatter
from typing import Any

from experiments.evidence import ROOT, SOURCES, Evidence, Records, path_of
from scp_recon.errors import InputError

PAGES = (
    ROOT / "README.md",
    *sorted(p for p in (ROOT / "docs").rglob("*.md") if p.parent.name != "reference"),
)
MARK = re.compile(r"<!--=(.*?)-->(.*?)<!--/-->", re.DOTALL)
FIELD = re.compile(r"(\w+)(?:\.(\w+))?\[([^\]]*)\]\.(.+)")
FORM = re.compile(r"(?:\*(\S+) )?(.*)")


def render(text: str) -> str:
    """A page's text with every mark filled anew.

    Raises:
        InputError: if a mark names evidence, a row or a column that does not exist.
    """
    return MARK.sub(lambda mark: f"<!--={mark[1]}-->{_filled(mark[1])}<!--/-->", text)


def used(text: str) -> list[str]:
    """Names of the evidence from which a page's figures and pictures come, in their order."""
    drawn = {Path(target).name for target in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)}
    names = [
        name
        for name, source in SOURCES.items()
        if any(Path(figure.split()[-1]).name in drawn for figure in source.figures)
    ]
    for template in (mark[1] for mark in MARK.finditer(text)):
        head, _, body = template.partition("\n")
        names += re.findall(r"\{(\w+)(?:\.\w+)?\[", template)
        names += re.findall(r"\w+", head)[:1] if body else []
    return list(dict.fromkeys(names))


def behind() -> dict[Path, str]:
    """Pages of which a figure is not the evidence's: their text as it should be.

    Raises:
        InputError: if a mark names evidence, a row or a column that does not exist.
    """
    _tables.cache_clear()
    texts = {page: page.read_text("utf-8") for page in PAGES}
    return {page: new for page, text in texts.items() if (new := render(text)) != text}


def _filled(template: str) -> str:
    head, several, body = template.partition("\n")
    if not several:
        return _Filler({}).format(template.strip())
    name, _, conditions = head.strip().partition(" ")
    lines = list[str]()
    for line in body.strip("\n").split("\n"):
        if any("[" not in field for field in _fields(line)):
            rows = _matching(_table(*name.split(".")), conditions)
            if not rows:
                raise InputError(head.strip(), "no row", "must be a table and conditions on it")
            lines += [_Filler(row).format(line) for row in rows]
        else:
            lines.append(_Filler({}).format(line))
    return "\n" + "\n".join(lines) + "\n"


def _fields(line: str) -> Iterator[str]:
    return (field for _, field, _, _ in Formatter().parse(line) if field is not None)


class _Filler(Formatter):
    """Fills fields from a row and from all evidence."""

    def __init__(self, row: Mapping[str, Any]) -> None:
        self._row = row

    def get_field(self, field_name: str, args: Any, kwargs: Any) -> tuple[Any, str]:  # noqa: ARG002  Formatter's
        whole = FIELD.fullmatch(field_name)
        if whole is None:
            return _value(self._row, field_name), ""
        name, table, key, column = whole.groups()
        return _value(_row(_table(name, table), key, field_name), column), ""

    def format_field(self, value: Any, format_spec: str) -> str:
        factor, form = FORM.fullmatch(format_spec).groups()  # type: ignore[union-attr]  # matches all
        if value is None or isinstance(value, str):
            return value or ""
        if isinstance(value, bool):
            return "yes" if value else "no"
        return format(value * float(factor) if factor else value, form)


def _value(row: Mapping[str, Any], column: str) -> Any:
    if column not in row:
        raise InputError(column, "no such column", f"must be one of {', '.join(row)}")
    return row[column]


@cache
def _tables(name: str) -> Mapping[str, Records]:
    try:
        return Evidence.read(path_of(name)).tables
    except FileNotFoundError:
        raise InputError(name, "no such evidence", "must be a file of docs/evidence") from None


def _table(name: str, table: str | None = None) -> Records:
    tables = _tables(name)
    if (table or name) not in tables:
        raise InputError(f"{name}.{table}", "no such table", f"must be one of {', '.join(tables)}")
    return tables[table or name]


def _row(rows: Records, key: str, field: str) -> Mapping[str, Any]:
    """The one row of a key."""
    found: Records = _matching(rows, key) if "=" in key else []
    for cells in () if "=" in key else (1, 2, 3):
        found = found or [r for r in rows if " ".join(map(_shown, [*r.values()][:cells])) == key]
    if len(found) != 1:
        raise InputError(field, f"{len(found)} rows", "must be of exactly one row")
    return found[0]


def _matching(rows: Records, conditions: str) -> Records:
    for condition in filter(None, (part.strip() for part in conditions.split(";"))):
        column, _, words = condition.partition("=")
        values = tuple(words.split("|"))
        if column.endswith("^"):
            rows = [row for row in rows if str(_value(row, column[:-1])).startswith(values)]
        else:
            rows = [row for row in rows if _shown(_value(row, column)) in values]
    return rows


def _shown(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
